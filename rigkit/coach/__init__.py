"""The coach: a local page that says what picture to take next, takes it, and says when there are enough."""
