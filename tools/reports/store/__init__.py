"""Report on bakes into an object store: a discrete-event model of claiming workers, and what the real ones ask of a store."""
