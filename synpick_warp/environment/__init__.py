"""Vector environment of suction picking for reinforcement learning, planning and the evaluation of pickers."""
