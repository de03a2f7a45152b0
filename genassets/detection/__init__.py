"""Detection: info files that detectors read, BEVFormer-tiny in plain torch, its training and decoding."""
