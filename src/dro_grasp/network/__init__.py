"""The D(R,O) network: tensors in, tensors out."""
