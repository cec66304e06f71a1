"""Synthetic studies: the estimators over noise, pose types and boards."""
