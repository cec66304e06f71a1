"""Outputs of several verbs: folders of results, provenance, cameras in other tools' formats."""
