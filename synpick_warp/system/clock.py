"""Clock and threads of claims, commits and uploads: the operating system's, or in tests those of a deterministic simulation.

A module of its own, since a simulation replaces these names in one place: users write `clock.sleep(1.0)` and import none of them.
"""

import threading
import time as _system
from concurrent.futures import ThreadPoolExecutor

time, monotonic, sleep = _system.time, _system.monotonic, _system.sleep
Event, Lock, Thread = threading.Event, threading.Lock, threading.Thread
Executor = ThreadPoolExecutor
