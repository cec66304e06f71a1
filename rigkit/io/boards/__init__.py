"""Boards from rigkit's board files, from words such as 9x6x25, and from other tools' target files."""
