"""Long runs: checkpoint of finished shards, manifest, lock, heartbeat of several processes."""
