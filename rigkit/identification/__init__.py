"""Identification of boards and of their first corners."""
