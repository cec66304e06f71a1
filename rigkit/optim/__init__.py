"""Nonlinear least squares (Levenberg-Marquardt) and robust scale estimates, used by the whole package."""
