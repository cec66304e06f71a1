"""Where a second camera stands: solvers, their refinement by maximum likelihood, robust estimation."""
