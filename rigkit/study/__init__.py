"""Synthetic studies of the estimators over noise, pose types and boards."""
