"""Images as another camera would have taken them: perspective, stereo pairs, panoramas."""
