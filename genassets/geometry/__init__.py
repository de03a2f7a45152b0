"""Rigid transforms, boxes, pinhole cameras and turntable views, in float64 numpy."""
