"""Learn a room's light: models, light transport, and their training and choice."""
