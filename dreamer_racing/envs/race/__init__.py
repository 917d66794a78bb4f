"""Race rules: gates, rewards, starts, the racing line and the scripted pilot that flies it."""
