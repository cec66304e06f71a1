"""Every shared tolerance, with its reason."""

EXACT_REL = 1e-9
"""Noise-free algebra on well-conditioned data."""

JACOBIAN_REL = 1e-6
"""Central differences with relative step 1e-6 are right to about 1e-10 here; a sign flip is 2."""

ROUND_TRIP_PX = 1e-8
"""A correct polynomial round trip measures 2e-13 px; a wrong stretch gives 3e-3."""

ROUNDING = 1e-12
"""A handful of double operations on numbers of order 1."""
