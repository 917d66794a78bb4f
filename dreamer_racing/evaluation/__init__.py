"""Flying a policy and measuring it, and its world model."""
