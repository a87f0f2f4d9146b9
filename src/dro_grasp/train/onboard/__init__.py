"""A hand that nobody prepared: from its description to weights that grasp with it, and a report."""
