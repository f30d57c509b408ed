//! Launches `splat-kernels` on CubeCL devices: CUDA, Vulkan, Metal, WebGPU.
