"""Strict readers, and atomic writers, of any file."""
