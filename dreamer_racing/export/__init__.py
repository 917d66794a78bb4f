"""The actor as a file. Nothing is imported here: `onnx_actor` flies without torch and can be copied alone."""
