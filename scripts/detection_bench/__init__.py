"""What measures detection: rendered scenes with exact truth, their scores, the Cramer-Rao bound of their corners."""
