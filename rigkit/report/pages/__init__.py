"""The pages that verbs write, what they say, and their charts."""
