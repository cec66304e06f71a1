"""What a person writes: sessions, data sets, studies, and what was measured."""
