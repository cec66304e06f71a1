"""Nonlinear least squares and robust scale: how every descent of the package damps its steps and knows when to stop."""
