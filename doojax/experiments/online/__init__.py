"""Learning from one's own trials: plan, execute, learn from what came of it, and again."""
