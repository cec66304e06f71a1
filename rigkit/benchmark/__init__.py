"""What measures detection: scenes with exact truth, their scores, the Cramer-Rao bound."""
