"""How images are searched for each kind of target: one file a pattern, one registry."""
