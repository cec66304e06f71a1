"""Files that people write: sessions, data sets, studies, and measured truth."""
