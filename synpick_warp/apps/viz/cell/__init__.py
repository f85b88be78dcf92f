"""Pictures of a cell before anything is simulated: from outside, with the cameras' frusta, and from each camera."""
