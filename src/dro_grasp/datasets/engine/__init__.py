"""Production of grasp data: shards, made by pools of processes or machines."""
