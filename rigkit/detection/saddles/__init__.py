"""Where corners of a chessboard may be: brightness, rings, saddle points."""
