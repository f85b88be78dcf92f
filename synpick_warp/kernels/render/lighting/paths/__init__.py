"""Path tracing: the reference tracer, and the coarse path pass with its lists, queues and light."""
