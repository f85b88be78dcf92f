"""Batched suction environment for reinforcement learning, planning and evaluation of pickers."""
