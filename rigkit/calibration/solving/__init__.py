"""One camera model fitted to all views: a start without any guess, then least squares by steps that eliminate poses."""
