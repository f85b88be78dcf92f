"""Host side of the simulation: worlds, physics, the stages of a tick."""
