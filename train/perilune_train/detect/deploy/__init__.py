"""Networks for flight: ONNX, OpenVINO, int8."""
