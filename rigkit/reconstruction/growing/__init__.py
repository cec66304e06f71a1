"""A dense cloud of a scene without boards: matches that grow over surfaces, posed again, fused over views."""
