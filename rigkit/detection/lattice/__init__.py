"""From loose corners to grids: links, growth, where a grid splits."""
