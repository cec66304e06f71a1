"""The planner's benchmark on real captures."""
