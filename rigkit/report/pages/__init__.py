"""The HTML pages of verbs: their facts, charts and drawings."""
