"""Measurements as tensors, as tables and as files. What a program or a filter says of them lives further up."""
