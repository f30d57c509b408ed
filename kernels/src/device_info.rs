//! Device properties that select kernel variants, and the variants selected.

use cubecl::client::Client;
use cubecl::features::{AtomicUsage, Plane};

use crate::launch::{MOST_BUFFERS, bindable_buffers};
use crate::{rasterize, sort};

/// Properties of the client's device, as names and values in display order.
pub fn device_info(client: &Client) -> Vec<(&'static str, String)> {
    let (identity, hardware) = (&client.properties().identity, &client.properties().hardware);
    let planes = match (hardware.plane_size_min, hardware.plane_size_max) {
        (least, most) if least == most => format!("{most} units"),
        (least, most) => format!("{least} to {most} units"),
    };
    let operations = if client.features().plane.contains(Plane::Ops) {
        "with plane operations"
    } else {
        "without plane operations"
    };
    let adding = client.features().types.atomic.iter();
    let adding = adding.filter(|(_, uses)| uses.contains(AtomicUsage::Add));
    let adding: Vec<String> = adding.map(|(value, _)| value.to_string()).collect();
    let mut facts = vec![
        ("name", identity.name.clone()),
        ("runtime", client.name().to_owned()),
        ("planes", format!("{planes}, {operations}")),
        ("atomic addition", adding.join(", ")),
        (
            "shared memory",
            format!("{} bytes a workgroup", hardware.max_shared_memory_size),
        ),
    ];
    let buffers = format!(
        "{} a kernel, {MOST_BUFFERS} needed",
        bindable_buffers(client)
    );
    facts.push(("storage buffers", buffers));
    if let Some(count) = hardware.num_streaming_multiprocessors {
        facts.push(("multiprocessors", count.to_string()));
    }
    if let Some(bytes) = hardware.last_level_cache_size {
        facts.push(("last cache", format!("{bytes} bytes")));
    }
    facts.push(("rasterize", rasterize::variant(client)));
    facts.push((
        "sums without order",
        rasterize::unordered(client).to_owned(),
    ));
    facts.push(("sort", sort::variant(client)));
    facts
}
