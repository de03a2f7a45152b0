"""Actors as people take them away: meshes, turntables and pictures."""
