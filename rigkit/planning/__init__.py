"""Planning of views: which image to take next, by the information it will give about the lens."""
