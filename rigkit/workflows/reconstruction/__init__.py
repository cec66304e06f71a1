"""Clouds and meshes: of a data set's pairs, of any scene, of a rig."""
