"""Camera models behind one protocol, found by name in the registry."""
