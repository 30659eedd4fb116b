"""Run a policy agent by agent: in Python, and as an exported ONNX model."""
