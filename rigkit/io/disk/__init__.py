"""Files as such: read strictly, written whole or not at all."""
