"""What several verbs write: folders of results, provenance, cameras for other tools."""
