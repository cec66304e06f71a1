"""Model selection: camera models and board shapes are compared by held-out error; orientation of symmetric boards."""
