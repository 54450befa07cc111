"""How a level set or its active voxels change: redistancing, wider bands, morphology."""
