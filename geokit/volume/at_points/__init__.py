"""What a volume says at points: values, gradients, active or not."""
