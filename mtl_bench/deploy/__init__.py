"""Networks as they are deployed: the graph, the engines that run it, their times, ONNX files."""
