"""Neural networks: Res-VAE, compressor, training, inference."""
