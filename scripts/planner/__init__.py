"""What the planner's benchmark measures on real captures."""
