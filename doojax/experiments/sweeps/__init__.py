"""Studies of one setting, of many models each."""
