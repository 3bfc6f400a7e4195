"""Pictures of dressed surfaces: scene, camera, lights, visibility, shading."""
