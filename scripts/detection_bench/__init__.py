"""Rendered scenes with exact truth, scores and Cramer-Rao bounds, to measure detection."""
