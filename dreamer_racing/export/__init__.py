"""Export of the actor. Nothing is imported here: `onnx_actor` runs without torch and can be copied alone."""
