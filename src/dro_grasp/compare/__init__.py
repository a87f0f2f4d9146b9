"""Sources side by side: the same hands and objects, the same finish, the same trials, and rates of what was asked for."""
