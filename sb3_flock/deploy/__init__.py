"""Policies outside this package: ONNX."""
