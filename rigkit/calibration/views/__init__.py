"""Views of boards: the usable ones, as arrays, and the folds of the cross-validation."""
