"""What the recipes share: from overrides to a run that can be started or continued."""
