"""Which view of which board belongs to which target and moment, and which were put together wrongly."""
