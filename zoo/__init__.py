"""Scripts that train, evaluate and show; each runs as ``python zoo/<script>.py`` from the repository root."""
