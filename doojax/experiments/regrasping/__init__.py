"""Regrasping with the grasp loop signature: control, traps, grasp planning and trials (thesis chapter 5)."""
