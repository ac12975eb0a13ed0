"""Plans and trials: planning, executing, recovering, on shared scenes, and their records."""
