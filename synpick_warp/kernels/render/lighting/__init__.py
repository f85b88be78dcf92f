"""Light transport: materials, BRDF, environment lighting, path tracing, denoising, shading."""
