"""AprilTags: reading their codes, and where their corners are."""
