"""Long runs: checkpoint of finished shards, manifest, folder, a cluster of workers."""
