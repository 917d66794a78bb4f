"""Everything drawn or filmed."""
