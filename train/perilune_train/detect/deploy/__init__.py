"""Export of networks for flight: ONNX, OpenVINO, int8."""
