"""Benchmarks: measured figures with their date, machine and command."""
