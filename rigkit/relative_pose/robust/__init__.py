"""The pose where some of the matches are wrong, and whether chance alone would have found it."""
