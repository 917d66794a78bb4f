"""What a policy meets: collected, dealt to streams, kept in a replay."""
