"""Policies outside this package: ONNX, and C for microcontrollers."""
