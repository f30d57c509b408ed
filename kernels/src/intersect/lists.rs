//! From splats to lists, launch by launch.

use cubecl::prelude::*;

use super::kernels::{find_visible, gather, pack_visible, tile_ranges, walk_tiles};
use super::{Frames, Slots, TileLists};
use crate::launch::{Buffer, per_element};
use crate::scan::{PendingTotal, exclusive_sum, exclusive_sum_with_total};
use crate::sort::{bits_for, sort_first_pairs};

/// The visible splats in order, and the starts of their slots: everything known before memory for
/// intersections is reserved.
pub(super) struct Counted<'a> {
    packed: &'a Buffer,
    opacities: &'a Buffer,
    frames: &'a Frames,
    visible: Buffer,
    order: Buffer,
    offsets: Buffer,
}

impl<'a> Counted<'a> {
    pub(super) fn new(
        client: &'a Client,
        packed: &'a Buffer,
        opacities: &'a Buffer,
        frames: &'a Frames,
    ) -> (Self, PendingTotal<'a>) {
        let splats = frames.splats();
        let flags = Buffer::empty(client, splats + 1);
        if let Some((count, dim)) = per_element(splats + 1) {
            find_visible::launch(
                client,
                count,
                dim,
                packed.arg(),
                opacities.arg(),
                flags.arg(),
                frames.uniforms(),
            );
        }
        let visible = exclusive_sum(client, &flags);
        let depths = Buffer::empty(client, splats);
        let indices = Buffer::empty(client, splats);
        if let Some((count, dim)) = per_element(splats) {
            pack_visible::launch(
                client,
                count,
                dim,
                packed.arg(),
                visible.arg(),
                depths.arg(),
                indices.arg(),
                splats as u32,
            );
        }
        let count = (&visible, splats as u32);
        let (_, order) = sort_first_pairs(client, &depths, &indices, count, 32);
        let mut counted = Self {
            packed,
            opacities,
            frames,
            visible,
            order,
            offsets: Buffer::empty(client, splats + 1),
        };
        let none = [(); 3].map(|()| Buffer::empty(client, 1));
        counted.walk(client, none.each_ref(), 0, false);
        let (offsets, total) = exclusive_sum_with_total(client, &counted.offsets);
        counted.offsets = offsets;
        (counted, total)
    }

    /// Counts the tiles of every splat, or emits keys, slots and splats of the intersections.
    fn walk(&self, client: &Client, out: [&Buffer; 3], capacity: usize, emit: bool) {
        let [keys, slots, slot_splats] = out;
        if let Some((count, dim)) = per_element(self.frames.splats() + 1) {
            walk_tiles::launch(
                client,
                count,
                dim,
                self.packed.arg(),
                self.opacities.arg(),
                self.visible.arg(),
                self.order.arg(),
                self.offsets.arg(),
                keys.arg(),
                slots.arg(),
                slot_splats.arg(),
                self.frames.uniforms(),
                capacity as u32,
                emit,
            );
        }
    }

    /// Builds the lists, for at most `capacity` intersections. `intersections` of the result is the
    /// capacity.
    pub(super) fn list(&self, client: &Client, capacity: usize) -> TileLists {
        let tiles = self.frames.tiles();
        let at = self.frames.splats() as u32;
        let out = [(); 3].map(|()| Buffer::empty(client, capacity));
        if capacity > 0 {
            self.walk(client, out.each_ref(), capacity, true);
        }
        let [keys, slots, slot_splats] = out;
        let count = (&self.offsets, at);
        let (keys, slots) = sort_first_pairs(client, &keys, &slots, count, bits_for(tiles + 1));

        let ranges = Buffer::empty(client, tiles * 2);
        if let Some((count, dim)) = per_element(tiles) {
            tile_ranges::launch(
                client,
                count,
                dim,
                keys.arg(),
                self.offsets.arg(),
                ranges.arg(),
                at,
                capacity as u32,
                tiles as u32,
            );
        }
        let tile_splats = Buffer::empty(client, capacity);
        if let Some((count, dim)) = per_element(capacity) {
            gather::launch(
                client,
                count,
                dim,
                slots.arg(),
                slot_splats.arg(),
                self.offsets.arg(),
                tile_splats.arg(),
                at,
                capacity as u32,
            );
        }
        TileLists {
            intersections: capacity,
            splats: tile_splats,
            ranges,
            slots: Some(Slots {
                of: slots,
                visible: self.visible.clone(),
                order: self.order.clone(),
                offsets: self.offsets.clone(),
            }),
        }
    }
}
