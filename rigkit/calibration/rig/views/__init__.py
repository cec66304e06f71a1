"""Assignment of views to targets and frames, and detection of mix-ups."""
