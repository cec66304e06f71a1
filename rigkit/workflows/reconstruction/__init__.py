"""Clouds and meshes from the pairs of a data set, from any scene, or from a rig."""
