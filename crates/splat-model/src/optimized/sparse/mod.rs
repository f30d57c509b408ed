//! Steps of the rows alone that the views of a step may see.
//!
//! Consecutive rows form groups, of which boxes are kept (`bounds`). A group that no camera of a
//! step can see (`frustum`) has no part in the step: it is neither projected nor stepped. What full
//! Adam would have done to it in the meantime is made up for when it is next needed (`missed`).

mod bounds;
mod frustum;
mod missed;
mod part;
mod save;
#[cfg(all(test, feature = "cpu"))]
mod tests;

use std::borrow::Cow;
use std::collections::BTreeMap;

use burn::module::Module;
use burn::tensor::Gradients;
use splat_data::Camera;
use splat_ops::{AdamGap, OpError, ProjectSettings, RowGroups};

use super::fields::{FieldVisitor, GradientsOf, change};
use super::owned::Owner;
use super::{FieldGradients, FieldStep, Optimized};
use crate::SplatModel;
use crate::field::{Field, GAUSSIANS};
use bounds::{Bounds, GroupBox};
use frustum::Frustum;
use missed::{Missed, MissedSteps, farthest};

pub use part::Part;

/// Rows of a group: small enough for tight boxes, large enough that testing all of them costs
/// nothing.
const GROUP: usize = 256;
/// Most rows of a group.
const LARGEST_GROUP: usize = 1 << 16;
/// Steps of all rows by which boxes are widened before they are measured again.
const MOST_WIDENED: usize = 16;
/// Steps after which all rows catch up, so that the list of missed steps stays short.
const MOST_MISSED: usize = 1000;
/// Fields whose rows are boxed.
const BOXED: [&str; 2] = ["means", "log_scales"];

/// A model and its optimisers, of which a step may leave out the Gaussians that its views do not
/// see, with the result of full Adam.
///
/// Rows that were left out are behind: what Adam does without a gradient, the decay of moments and
/// the drift along them, is done to them later and all at once. The model with all rows caught up
/// is what [`model`](Self::model) and [`whole`](Self::whole) give; there is no way to the rows that
/// are behind.
///
/// The sum that replaces k steps is that of the steps' own rates and bias corrections. It differs
/// from k single steps by rounding: half a unit in the last place of the parameter for each step,
/// and one part in 10^7 of the drift.
///
/// ```
/// use burn::tensor::Device;
/// use splat_model::ops::{AdamRows, ImageSize, ProjectSettings};
/// use splat_model::{
///     Camera, CameraTensors, FieldStep, Gaussians, LearningRates, Lens, Optimized,
///     RenderSettings, SceneScale, SparseOptimized, SplatData, render,
/// };
///
/// // Two groups of Gaussians, before the camera and behind it.
/// let means: Vec<_> = (0..512).map(|i| [0.0, 0.0, if i < 256 { 4.0 } else { -4.0 }]).collect();
/// let splats = SplatData {
///     log_scales: vec![[-2.0; 3]; 512],
///     quats: vec![[1.0, 0.0, 0.0, 0.0]; 512],
///     opacity_logits: vec![0.0; 512],
///     sh0: vec![[0.5; 3]; 512],
///     means,
///     ..SplatData::default()
/// };
/// let device = Device::flex().autodiff();
/// let (rates, scale) = (LearningRates::new(), SceneScale::new(4.0).unwrap());
/// let gaussians = Gaussians::from_data(&splats, &device);
/// let model = Optimized::with_adam(gaussians, &rates, AdamRows::All, scale)?;
/// let mut model = SparseOptimized::new(model);
///
/// let camera = Camera {
///     viewmat: glam::DMat4::IDENTITY,
///     intrinsics: [50.0, 50.0, 32.0, 24.0],
///     lens: Lens::Pinhole,
///     size: ImageSize { width: 64, height: 48 },
/// };
/// let rows = model.seen(&[camera], &ProjectSettings::default()).expect("a model of Gaussians");
/// assert_eq!(rows.len(), 256);
/// let part = model.part(rows);
/// let cameras = CameraTensors::from_camera(&camera, &device);
/// let loss = render(part.model(), &cameras, &RenderSettings::new())?.image().sum();
/// let gradients = part.gradients(&model, &mut loss.backward());
/// model.step_part(part, gradients, |field| (field.rate, FieldStep::Step(1.0)))?;
/// assert_eq!(model.count(), 512);
/// let means = model.model().to_data().means;
/// assert!(means[0] != splats.means[0] && means[300] == splats.means[300]);
/// # Ok::<(), splat_model::ops::OpError>(())
/// ```
#[derive(Debug)]
pub struct SparseOptimized<M> {
    /// With rows that may be behind.
    behind: Optimized<M>,
    group: usize,
    missed: MissedSteps,
    /// By group, how many of the missed steps its rows have taken or made up for. Empty where there
    /// are none.
    taken: Vec<u32>,
    bounds: Option<Bounds>,
}

/// What rows have missed, by field, and by the last step that they took part in.
type MissedByField = BTreeMap<String, Vec<Missed>>;

impl<M: SplatModel> SparseOptimized<M> {
    /// A model whose rows are all up to date.
    pub fn new(mut model: Optimized<M>) -> Self {
        model.owner.get_or_insert_with(Owner::new);
        Self {
            behind: model,
            group: GROUP,
            missed: MissedSteps::default(),
            taken: Vec::new(),
            bounds: None,
        }
    }

    /// The same with groups of so many rows, 1 to 65,536, instead of 256. Small groups have tight
    /// boxes, of which there are many.
    #[must_use]
    pub fn with_group_size(mut self, rows: usize) -> Self {
        self.catch_up_all();
        self.bounds = None;
        self.group = rows.clamp(1, LARGEST_GROUP);
        self
    }

    /// The model. Where rows are behind, a copy in which they are not: reading changes nothing.
    pub fn model(&self) -> Cow<'_, M> {
        let Some(rows) = self.rows_behind() else {
            return Cow::Borrowed(self.behind.model());
        };
        let missed = self.missed();
        let mut model = Some(self.behind.model().clone());
        change(&mut model, self.behind.names(), |name, value| {
            match (missed.get(name), self.behind.optimizers.get(name)) {
                (Some(missed), Some(optimizer)) => {
                    let gaps = self.gaps(&rows, missed);
                    optimizer.caught_up(value, &rows, &gaps).expect(FITS)
                }
                _ => value,
            }
        });
        Cow::Owned(model.expect(super::WHOLE))
    }

    /// The model and its optimisers, with all rows caught up for good.
    pub fn whole(&mut self) -> &mut Optimized<M> {
        self.catch_up_all();
        &mut self.behind
    }

    /// The model and its optimisers.
    pub fn into_whole(mut self) -> Optimized<M> {
        self.catch_up_all();
        self.behind
    }

    /// Number of Gaussians.
    pub fn count(&self) -> usize {
        self.behind.model().count()
    }

    /// Origin of the means in the world.
    pub fn origin(&self) -> [f64; 3] {
        self.behind.model().origin()
    }

    /// The trained fields.
    pub fn fields(&self) -> &[Field] {
        self.behind.fields()
    }

    /// True if steps of some rows are the same as steps of all: the model says that its Gaussians
    /// are independent ([`SplatModel::is_row_wise`], which those of different degrees of spherical
    /// harmonics are not here, since one has several rows of a field), every field of theirs is
    /// stepped by [`SplatAdam`](crate::optimizer::SplatAdam), and no gradient waits for another
    /// step.
    pub fn can_be_sparse(&self) -> bool {
        let rows: Vec<&Field> = self.row_fields().collect();
        let has = |name: &&str| rows.iter().any(|field| field.name == **name);
        self.behind.model().is_row_wise()
            && BOXED.iter().all(has)
            && self.behind.waiting.is_empty()
            && (rows.iter()).all(|field| self.behind.optimizers[&field.name].adam().is_some())
    }

    /// The rows that these cameras may see, rendered with these settings: none that the projection
    /// would draw is missing. `None` if a step of some rows is not the same as a step of all.
    pub fn seen(&mut self, cameras: &[Camera], settings: &ProjectSettings) -> Option<RowGroups> {
        if !self.can_be_sparse() {
            return None;
        }
        self.measure();
        let (missed, bounds) = (self.missed(), self.bounds.as_ref()?);
        let drift = self.drift(&missed);
        let frusta: Vec<Frustum> = (cameras.iter())
            .map(|camera| Frustum::new(camera, settings))
            .collect();
        let chosen = (0..).zip(&bounds.boxes).filter(|(group, own)| {
            let [means, log_scales] = drift[self.last(*group)];
            let own = own.widened(means, log_scales);
            !frusta.iter().all(|frustum| frustum.misses(&own))
        });
        let chosen = chosen.map(|(group, _)| group).collect();
        RowGroups::new(self.group, self.count(), chosen)
    }

    /// These rows as a model of their own, caught up, with all parameters that have no rows. Its
    /// parameters are leaves of the autodiff graph.
    pub fn part(&mut self, rows: RowGroups) -> Part<M> {
        let missed = self.missed();
        self.catch_up(&rows, &missed);
        let part = Part::gather(&self.behind, rows);
        if let Some(bounds) = &mut self.bounds {
            for (group, own) in part.boxes() {
                if let Some(place) = bounds.boxes.get_mut(group as usize) {
                    *place = own;
                }
            }
        }
        part
    }

    /// Steps the rows of a part along the gradients of its fields, and fields without rows as ever.
    /// `how` returns the rate of each and what to do.
    ///
    /// # Errors
    /// When a gradient has another shape than its field in the part, the part is of other rows than
    /// the model has now, or `how` wants a field not to step. Nothing has been stepped then.
    pub fn step_part(
        &mut self,
        part: Part<M>,
        mut gradients: FieldGradients,
        how: impl Fn(&Field) -> (f64, FieldStep),
    ) -> Result<(), OpError> {
        let wrong = |what: String| OpError::Argument {
            op: "SparseOptimized::step_part",
            what,
        };
        // The part holds memory that a step writes into.
        let rows = part.into_rows();
        if rows.count() != self.count() || rows.size() != self.group {
            return Err(wrong("the part is of other rows than the model has".into()));
        }
        let shapes = self.behind.shapes();
        let mut steps = BTreeMap::new();
        let mut rates = BTreeMap::new();
        for field in &self.behind.fields {
            let Some(gradient) = gradients.remove(&field.name) else {
                continue;
            };
            let in_rows = field.row_set == Some(GAUSSIANS);
            let mut expected = shapes[&field.name];
            if in_rows {
                expected[0] = rows.len();
            }
            if gradient.dims() != expected {
                let (name, found) = (&field.name, gradient.dims());
                return Err(wrong(format!(
                    "the gradient of `{name}` has shape {found:?}, the part's field {expected:?}"
                )));
            }
            let (rate, FieldStep::Step(factor)) = how(field) else {
                let name = &field.name;
                return Err(wrong(format!("`{name}` is not to step; step all rows")));
            };
            let rate = rate * factor;
            if in_rows {
                rates.insert(field.name.clone(), rate);
            }
            steps.insert(field.name.clone(), (rate, gradient, in_rows));
        }
        if let Some(name) = gradients.keys().next() {
            return Err(wrong(format!("`{name}` is no field of the model")));
        }
        self.begin_missing();
        let optimizers = &mut self.behind.optimizers;
        let names = names(&self.behind.fields);
        change(&mut self.behind.model, names, |name, value| {
            match (steps.remove(name), optimizers.get_mut(name)) {
                (Some((rate, gradient, true)), Some(optimizer)) => {
                    let stepped = optimizer.step_groups(rate, value, gradient, &rows);
                    stepped.expect(FITS)
                }
                (Some((rate, gradient, false)), Some(optimizer)) => {
                    optimizer.step(rate, value, gradient)
                }
                _ => value,
            }
        });
        self.missed.push(&rates);
        self.take(&rows);
        if self.missed.len() >= MOST_MISSED {
            self.catch_up_all();
        }
        Ok(())
    }

    /// [`Optimized::step`], after which the boxes of rows are still known.
    ///
    /// # Errors
    /// Those of [`Optimized::step`].
    pub fn step(
        &mut self,
        gradients: FieldGradients,
        how: impl Fn(&Field) -> (f64, FieldStep),
    ) -> Result<(), OpError> {
        self.catch_up_all();
        let known = (self.bounds.take()).filter(|bounds| {
            bounds.version == self.behind.version && bounds.widened < MOST_WIDENED
        });
        let moves = known.is_some().then(|| self.farthest_step(&how)).flatten();
        self.behind.step(gradients, how)?;
        self.bounds = known.zip(moves).map(|(mut bounds, [means, log_scales])| {
            for own in &mut bounds.boxes {
                *own = own.widened(means, log_scales);
            }
            bounds.version = self.behind.version;
            bounds.widened += 1;
            bounds
        });
        Ok(())
    }

    /// Furthest that the next step can move means and logarithms of scales.
    fn farthest_step(&self, how: &impl Fn(&Field) -> (f64, FieldStep)) -> Option<[f64; 2]> {
        let of_field = |name: &str| {
            let field = self.behind.fields.iter().find(|field| field.name == name)?;
            let optimizer = &self.behind.optimizers[name];
            let adam = optimizer.adam()?;
            let rate = match how(field) {
                (rate, FieldStep::Step(factor)) => rate * factor,
                _ => 0.0,
            };
            Some(farthest(adam) * adam.step_at(rate, optimizer.time() + 1).rate.abs())
        };
        let [means, log_scales] = BOXED.map(of_field);
        Some([means?, log_scales?])
    }

    /// Fields that have a row for each Gaussian.
    fn row_fields(&self) -> impl Iterator<Item = &Field> {
        let fields = self.behind.fields.iter();
        fields.filter(|field| field.row_set == Some(GAUSSIANS))
    }

    fn missed(&self) -> MissedByField {
        self.row_fields()
            .filter_map(|field| {
                let optimizer = &self.behind.optimizers[&field.name];
                let adam = optimizer.adam()?;
                let missed = self.missed.of_field(&field.name, adam, optimizer.time());
                Some((field.name.clone(), missed))
            })
            .collect()
    }

    /// By the last step that rows took part in, how far means and logarithms of scales may have
    /// come since their box was measured, before that step.
    fn drift(&self, missed: &MissedByField) -> Vec<[f64; 2]> {
        let of_field = |name: &str, last: usize| {
            let adam = self.behind.optimizers.get(name).and_then(|own| own.adam());
            let missed = missed.get(name).and_then(|missed| missed.get(last));
            adam.zip(missed)
                .map_or(0.0, |(adam, missed)| missed.drift(adam))
        };
        (0..=self.missed.len())
            .map(|last| BOXED.map(|name| of_field(name, last)))
            .collect()
    }

    /// Number of the last step that a group took part in.
    fn last(&self, group: u32) -> usize {
        self.taken
            .get(group as usize)
            .map_or(0, |last| *last as usize)
    }

    fn gaps(&self, rows: &RowGroups, missed: &[Missed]) -> Vec<AdamGap> {
        let gap = |group: &u32| {
            missed
                .get(self.last(*group))
                .map_or(AdamGap::NONE, |m| m.gap)
        };
        rows.chosen().iter().map(gap).collect()
    }

    /// The rows that have missed a step, if there are any.
    fn rows_behind(&self) -> Option<RowGroups> {
        let steps = self.missed.len() as u32;
        let behind = (0..).zip(&self.taken).filter(|(_, last)| **last < steps);
        let behind: Vec<u32> = behind.map(|(group, _)| group).collect();
        let rows = RowGroups::new(self.group, self.count(), behind)?;
        (!rows.chosen().is_empty()).then_some(rows)
    }

    /// Does to rows what they have missed.
    fn catch_up(&mut self, rows: &RowGroups, missed: &MissedByField) {
        let steps = self.missed.len();
        if rows.chosen().iter().all(|group| self.last(*group) == steps) {
            return;
        }
        let gaps: BTreeMap<&str, Vec<AdamGap>> = missed
            .iter()
            .map(|(name, missed)| (name.as_str(), self.gaps(rows, missed)))
            .collect();
        let optimizers = &mut self.behind.optimizers;
        let names = names(&self.behind.fields);
        change(&mut self.behind.model, names, |name, value| {
            match (gaps.get(name), optimizers.get_mut(name)) {
                (Some(gaps), Some(optimizer)) => optimizer.catch_up(value, rows, gaps).expect(FITS),
                _ => value,
            }
        });
        self.move_boxes(rows, missed);
        self.take(rows);
    }

    /// Widens the boxes of rows that catch up by how far they may have come.
    fn move_boxes(&mut self, rows: &RowGroups, missed: &MissedByField) {
        let drift = self.drift(missed);
        let lasts: Vec<usize> = rows
            .chosen()
            .iter()
            .map(|group| self.last(*group))
            .collect();
        let Some(bounds) = &mut self.bounds else {
            return;
        };
        for (group, last) in rows.chosen().iter().zip(lasts) {
            if let Some(own) = bounds.boxes.get_mut(*group as usize) {
                let [means, log_scales] = drift[last];
                *own = own.widened(means, log_scales);
            }
        }
    }

    fn catch_up_all(&mut self) {
        if self.missed.len() == 0 {
            return;
        }
        let missed = self.missed();
        if let Some(rows) = self.rows_behind() {
            self.catch_up(&rows, &missed);
        }
        // Those that took part in the last step have moved in it.
        let drift = self.drift(&missed);
        let [means, log_scales] = drift[self.missed.len()];
        if let Some(bounds) = &mut self.bounds {
            for own in &mut bounds.boxes {
                *own = own.widened(means, log_scales);
            }
        }
        self.missed = MissedSteps::default();
        self.taken = Vec::new();
    }

    /// Notes that rows have taken part in all steps so far.
    fn take(&mut self, rows: &RowGroups) {
        let steps = self.missed.len() as u32;
        for group in rows.chosen() {
            if let Some(last) = self.taken.get_mut(*group as usize) {
                *last = steps;
            }
        }
    }

    fn begin_missing(&mut self) {
        if self.missed.len() == 0 {
            self.taken = vec![0; self.count().div_ceil(self.group)];
        }
    }

    /// Measures the boxes of all groups, unless they are known.
    fn measure(&mut self) {
        let (count, version) = (self.count(), self.behind.version);
        let groups = count.div_ceil(self.group);
        let known = (self.bounds.as_ref())
            .is_some_and(|bounds| bounds.version == version && bounds.boxes.len() == groups);
        if known {
            return;
        }
        // Where this fails, steps are of all rows.
        let read = self.behind.read::<2>(BOXED).ok();
        self.bounds = read.map(|[means, log_scales]| Bounds {
            boxes: means
                .chunks(3 * self.group)
                .zip(log_scales.chunks(3 * self.group))
                .map(|(means, log_scales)| GroupBox::around(means, log_scales))
                .collect(),
            version,
            widened: 0,
        });
    }
}

fn names(fields: &[Field]) -> std::collections::HashMap<String, String> {
    let names = fields.iter();
    names
        .map(|field| (field.path.clone(), field.name.clone()))
        .collect()
}

/// Gradients of the fields of a part.
fn gradients_of<M: Module>(
    whole: &Optimized<M>,
    part: &M,
    gradients: &mut Gradients,
) -> FieldGradients {
    let mut taken = FieldGradients::new();
    part.visit(&mut FieldVisitor::new(
        whole.names(),
        GradientsOf {
            gradients,
            taken: &mut taken,
        },
    ));
    taken
}

/// Why steps of rows do not fail: values, moments and rows were made from each other.
const FITS: &str = "the optimiser is Adam, and its moments have the shape of their parameter";
