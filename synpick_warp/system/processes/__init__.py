"""Processes: workers, pools of them, isolation of native libraries, shared memory, signals."""
