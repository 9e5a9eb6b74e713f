"""Whole tasks: a base that moves, tendons that move, objects that are grasped and left."""
