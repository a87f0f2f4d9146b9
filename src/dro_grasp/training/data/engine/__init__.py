"""Production of grasp data: shards, made by processes of this machine or by a cluster."""
