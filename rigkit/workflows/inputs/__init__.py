"""Inputs of the verbs: sessions, video frames, corners and boards from images and videos; cameras from files."""
