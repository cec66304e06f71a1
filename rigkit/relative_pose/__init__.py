"""The relative pose of two cameras: solvers, maximum likelihood refinement, robust estimation."""
