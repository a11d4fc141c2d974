"""Many recordings of many arms: one model per arm from the moments of its recordings."""
