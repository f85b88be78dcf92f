"""Report on the depth sensor: simulated depth of annotated scenes beside the measured one."""
