"""The coach: a local page that says which image to take next, takes it, and says when there are enough."""
