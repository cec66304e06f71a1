"""Modules of `emulate.py`, which runs the tests of the kernels with libraries of other systems: the program that loads
such a library and calls it, and its proxy for the tests."""
