"""How sure a rig is, and what its cameras' models, triggers and lenses leave open."""
