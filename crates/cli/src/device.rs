//! `--device`: selection of a Burn device.

use burn::tensor::Device;
use clap::ValueEnum;
use splat_ops::device::device_info;

use super::{Failure, GlobalArgs};

/// Values of `--device`.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Default, ValueEnum)]
pub enum DeviceChoice {
    /// A real GPU if there is one, else the CPU
    #[default]
    Auto,
    /// The CPU
    Cpu,
    /// Vulkan, Metal, DirectX or WebGPU, software adapters included
    Wgpu,
    /// The same through SPIR-V, faster on GPUs with Vulkan; in a program built with the feature
    /// `vulkan`
    Vulkan,
    /// CUDA; in a program built with the feature `cuda`
    Cuda,
}

impl DeviceChoice {
    /// The value as typed.
    pub(super) fn argument(self) -> &'static str {
        match self {
            Self::Auto => "auto",
            Self::Cpu => "cpu",
            Self::Wgpu => "wgpu",
            Self::Vulkan => "vulkan",
            Self::Cuda => "cuda",
        }
    }
}

/// A device and its name, for the user and for `metrics.json`.
pub(super) struct ChosenDevice {
    pub device: Device,
    pub name: String,
}

impl ChosenDevice {
    /// The name and, for a CubeCL device, the properties that select kernel variants, with the
    /// variants selected.
    fn in_words(&self) -> String {
        let facts = device_info(&self.device).unwrap_or_default();
        let told = ["runtime", "planes", "atomic addition", "rasterize", "sort"];
        let facts = facts.iter().filter(|(name, _)| told.contains(name));
        let facts = facts.map(|(name, value)| format!("; {name}: {value}"));
        self.name.clone() + &facts.collect::<String>()
    }
}

/// Opens the chosen device and reports it in one line.
pub(super) fn open(global: &GlobalArgs) -> Result<ChosenDevice, Failure> {
    let chosen = match global.device {
        DeviceChoice::Cpu => cpu(),
        DeviceChoice::Wgpu => wgpu("wgpu"),
        DeviceChoice::Vulkan => vulkan(),
        DeviceChoice::Cuda => cuda(),
        DeviceChoice::Auto => cuda()
            .or_else(|_| real_gpu().ok_or(()))
            .or_else(|()| cpu().or_else(|_| wgpu("wgpu"))),
    }?;
    global.say(format_args!("device: {}", chosen.in_words()));
    if global.device == DeviceChoice::Auto && !cfg!(any(feature = "wgpu", feature = "cuda")) {
        global.say(
            "note: this program was built for the CPU alone; built with `--features wgpu` it takes a GPU where there is one",
        );
    }
    let facts = device_info(&chosen.device).unwrap_or_default();
    if may_crash(&facts) {
        global.say(
            "warning: this program gives SPIR-V to Vulkan (feature `vulkan`), on which older software Vulkan (llvmpipe \
             of Mesa 22.3 and 25.0) crashes; if it does, take --device cpu, or a program built without that feature",
        );
    }
    Ok(chosen)
}

/// True if a device is known to crash in its driver. That cannot be caught, only warned of.
fn may_crash(facts: &[(&'static str, String)]) -> bool {
    let has = |name, part| {
        facts
            .iter()
            .any(|(n, value)| *n == name && value.contains(part))
    };
    has("runtime", "spirv") && has("name", "llvmpipe")
}

#[cfg(feature = "cpu")]
fn cpu() -> Result<ChosenDevice, Failure> {
    Ok(ChosenDevice {
        device: Device::flex(),
        name: "cpu".to_owned(),
    })
}

#[cfg(not(feature = "cpu"))]
fn cpu() -> Result<ChosenDevice, Failure> {
    Err(not_built("cpu"))
}

/// The first adapter that is a GPU. Software adapters (lavapipe, llvmpipe, WARP) report themselves
/// as a CPU and are skipped; our own CPU path is many times faster.
#[cfg(feature = "wgpu")]
fn real_gpu() -> Option<ChosenDevice> {
    use burn::tensor::DeviceKind;
    let kinds = [
        DeviceKind::DiscreteGpu(0),
        DeviceKind::IntegratedGpu(0),
        DeviceKind::VirtualGpu(0),
    ];
    kinds.into_iter().find_map(|kind| {
        let device = Device::wgpu_options().device_kind(kind).init().ok()?;
        Some(named("wgpu", device))
    })
}

#[cfg(not(feature = "wgpu"))]
fn real_gpu() -> Option<ChosenDevice> {
    None
}

#[cfg(feature = "wgpu")]
fn wgpu(api: &str) -> Result<ChosenDevice, Failure> {
    let device = Device::wgpu_options().init();
    let device = device.map_err(|error| {
        Failure::BadInput(format!("--device {api}: no adapter can be used: {error}"))
    })?;
    Ok(named(api, device))
}

#[cfg(not(feature = "wgpu"))]
fn wgpu(_: &str) -> Result<ChosenDevice, Failure> {
    Err(not_built("wgpu"))
}

/// With this feature, wgpu compiles to SPIR-V if the adapter accepts it.
#[cfg(feature = "vulkan")]
fn vulkan() -> Result<ChosenDevice, Failure> {
    wgpu("vulkan")
}

#[cfg(not(feature = "vulkan"))]
fn vulkan() -> Result<ChosenDevice, Failure> {
    Err(not_built("vulkan"))
}

#[cfg(feature = "cuda")]
fn cuda() -> Result<ChosenDevice, Failure> {
    use burn::tensor::DeviceType;
    let device = Device::enumerate(DeviceType::Cuda).into_iter().next();
    let none = "--device cuda: no CUDA device was found. It takes an NVIDIA GPU and its driver (libcuda); --device wgpu \
                takes any GPU with Vulkan, Metal or DirectX, --device cpu none";
    let device = device.ok_or_else(|| Failure::BadInput(none.to_owned()))?;
    Ok(named("cuda", device))
}

#[cfg(not(feature = "cuda"))]
fn cuda() -> Result<ChosenDevice, Failure> {
    Err(not_built("cuda"))
}

#[cfg(any(feature = "wgpu", feature = "cuda"))]
fn named(api: &str, device: Device) -> ChosenDevice {
    let name = match device.identity() {
        Some(identity) => format!("{api} ({})", identity.name),
        None => api.to_owned(),
    };
    ChosenDevice { device, name }
}

#[cfg(not(all(feature = "cpu", feature = "vulkan", feature = "cuda")))]
fn not_built(feature: &str) -> Failure {
    Failure::BadInput(format!(
        "--device {feature}: this program was built without it; build with `--features {feature}`"
    ))
}

#[cfg(test)]
mod tests {
    use super::may_crash;

    #[test]
    fn only_spirv_on_software_vulkan_is_warned_of() {
        let facts = |name: &str, runtime: &str| {
            [("name", name.to_owned()), ("runtime", runtime.to_owned())]
        };
        let (software, hardware) = (
            "llvmpipe (LLVM 15.0.6, 256 bits)",
            "Intel(R) Arc(tm) Graphics",
        );
        assert!(may_crash(&facts(software, "wgpu<spirv>")));
        assert!(!may_crash(&facts(software, "wgpu<wgsl>")));
        assert!(!may_crash(&facts(hardware, "wgpu<spirv>")));
        assert!(!may_crash(&[]));
    }
}
