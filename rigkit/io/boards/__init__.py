"""Files of boards: as a person measured one, in a word, and those of other tools."""
