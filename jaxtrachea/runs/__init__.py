"""How a long run survives: shards, manifest, lock, several processes."""
