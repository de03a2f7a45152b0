"""Declarative experiments and datasets: YAML in, validated frozen models out."""
