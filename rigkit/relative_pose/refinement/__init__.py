"""The pose of maximum likelihood, and which type of pose the points speak for."""
