"""Options of the workflows: each is stated once, here, and the command line makes its arguments from it."""
