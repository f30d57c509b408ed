//! A model and the optimisers of its fields, stepped and edited together.

mod edit;
mod fields;
mod owned;
mod save;
mod sparse;
#[cfg(all(test, feature = "cpu"))]
mod tests;

use std::collections::{BTreeMap, HashMap};

use burn::module::Module;
use burn::tensor::{Element, Gradients, Tensor, Transaction};
use splat_data::SceneScale;
use splat_ops::{AdamRows, OpError};

use crate::field::{Field, SH_COEFFICIENTS};
use crate::opacity::logit;
use crate::optimizer::{FieldOptimizer, MomentEdit, SplatAdam};
use crate::{LearningRates, SplatModel};
use fields::{FieldVisitor, GradientsOf, Paths, Untracked, ValuesOf, change};
pub(crate) use fields::{outside_graph, tracked_field};
pub use owned::OwnedRows;
use owned::Owner;

/// Gradients by field name, each `[N, width]`; dimensions beyond the first are flattened.
pub type FieldGradients = BTreeMap<String, Tensor<2>>;

/// Action of the optimiser on a field in a step.
#[derive(Debug, Clone, Copy, PartialEq)]
pub enum FieldStep {
    /// A step, with the field's rate times this factor.
    Step(f64),
    /// No step; the gradient is added to the next one.
    Accumulate,
    /// No step; the gradient and any accumulated gradients are discarded.
    Skip,
}

/// A model, with an optimiser for each of its fields that owns the field's moments.
///
/// Rows of the model are edited only here, so that moments always match their rows.
///
/// ```
/// use burn::tensor::Device;
/// use splat_model::ops::AdamRows;
/// use splat_model::{FieldStep, Gaussians, LearningRates, Optimized, SceneScale, SplatData};
///
/// let splats = SplatData {
///     means: vec![[0.0; 3]],
///     log_scales: vec![[0.0; 3]],
///     quats: vec![[1.0, 0.0, 0.0, 0.0]],
///     opacity_logits: vec![0.0],
///     sh0: vec![[0.0; 3]],
///     ..SplatData::default()
/// };
/// let gaussians = Gaussians::from_data(&splats, &Device::flex().autodiff());
/// let (rates, scale) = (LearningRates::new(), SceneScale::new(1.0).unwrap());
/// let mut model = Optimized::with_adam(gaussians, &rates, AdamRows::All, scale)?;
/// let loss = model.model().opacities().sum();
/// let gradients = model.gradients(&mut loss.backward());
/// model.step(gradients, |field| (field.rate, FieldStep::Step(1.0)))?;
/// let [logits] = model.read(["opacity_logits"])?;
/// assert!((f64::from(logits[0]) + rates.opacities).abs() < 1e-4); // Adam's first step is the rate
/// # Ok::<(), splat_model::ops::OpError>(())
/// ```
#[derive(Debug)]
pub struct Optimized<M> {
    /// `None` while it is being changed.
    model: Option<M>,
    fields: Vec<Field>,
    optimizers: BTreeMap<String, FieldOptimizer>,
    /// Accumulated gradients.
    waiting: FieldGradients,
    /// Number of row edits so far.
    edits: usize,
    /// Number of times that values have changed.
    version: usize,
    /// Asked for the rows that belong to the Gaussians; `None` for a module that is no model.
    owner: Option<Owner<M>>,
}

pub use sparse::{Part, SparseOptimized};

impl<M: Module> Optimized<M> {
    /// A module with an optimiser for each of its fields; [`of_model`](Self::of_model) is for a
    /// [`SplatModel`], and knows of rows that belong to its Gaussians.
    ///
    /// # Errors
    /// When the model has no parameter at a field's path, two fields share a name, or a field is in
    /// the row set [`SH_COEFFICIENTS`], whose rows would not follow their Gaussians here.
    pub fn new(
        model: M,
        fields: Vec<Field>,
        optimizer: impl Fn(&Field) -> FieldOptimizer,
    ) -> Result<Self, OpError> {
        Self::build(model, fields, optimizer, None)
    }

    fn build(
        model: M,
        fields: Vec<Field>,
        optimizer: impl Fn(&Field) -> FieldOptimizer,
        owner: Option<Owner<M>>,
    ) -> Result<Self, OpError> {
        let optimizers = (fields.iter())
            .map(|field| (field.name.clone(), optimizer(field)))
            .collect::<BTreeMap<_, _>>();
        let trained = Self {
            model: Some(model),
            fields,
            optimizers,
            waiting: FieldGradients::new(),
            edits: 0,
            version: 0,
            owner,
        };
        trained.check_fields()?;
        Ok(trained)
    }

    /// A model with an optimiser for each of its fields, whose rates are from `rates`.
    ///
    /// # Errors
    /// When the model has no parameter at a field's path, or two fields share a name.
    pub fn of_model(
        model: M,
        rates: &LearningRates,
        optimizer: impl Fn(&Field) -> FieldOptimizer,
    ) -> Result<Self, OpError>
    where
        M: SplatModel,
    {
        let fields = model.fields(rates);
        Self::build(model, fields, optimizer, Some(Owner::new()))
    }

    /// A model with [`SplatAdam`] for each of its fields, stepping `rows`.
    ///
    /// # Errors
    /// Those of [`of_model`](Self::of_model).
    pub fn with_adam(
        model: M,
        rates: &LearningRates,
        rows: AdamRows,
        scene: SceneScale,
    ) -> Result<Self, OpError>
    where
        M: SplatModel,
    {
        Self::of_model(model, rates, |field| {
            SplatAdam::of_field(field, rows, scene).into()
        })
    }

    /// A module whose float parameters all train at one learning rate and have no rows, for modules
    /// trained beside a model.
    ///
    /// # Errors
    /// Those of [`new`](Self::new).
    pub fn of_module(
        module: M,
        rate: f64,
        optimizer: impl Fn(&Field) -> FieldOptimizer,
    ) -> Result<Self, OpError> {
        let mut paths = Paths::default();
        module.visit(&mut paths);
        let field = |path: String| Field {
            name: path.replace('.', "/"),
            path,
            ..Field::shared("", rate)
        };
        Self::new(
            module,
            paths.found.into_iter().map(field).collect(),
            optimizer,
        )
    }

    fn check_fields(&self) -> Result<(), OpError> {
        let wrong = |what: String| {
            Err(OpError::Argument {
                op: "SplatModel::fields",
                what,
            })
        };
        if self.optimizers.len() != self.fields.len() {
            return wrong("two fields have one name; give each its own".to_owned());
        }
        let names = self.names();
        if names.len() != self.fields.len() {
            return wrong("two fields have one path; a parameter is one field".to_owned());
        }
        let mut untracked = Untracked::default();
        self.model()
            .visit(&mut FieldVisitor::new(names, &mut untracked));
        if let Some(name) = untracked.0 {
            return wrong(format!(
                "autodiff does not track `{name}`; make the module on `device.autodiff()`, and declare no field for what is frozen"
            ));
        }
        if let Some(field) = self.fields.iter().find(|field| field.name.contains('.')) {
            return wrong(format!(
                "the name `{}` has a dot, which separates names in checkpoints",
                field.name
            ));
        }
        let owned = |field: &&Field| field.row_set == Some(SH_COEFFICIENTS);
        if let (None, Some(field)) = (self.owner, self.fields.iter().find(owned)) {
            return wrong(format!(
                "the rows of `{}` belong to Gaussians of different degrees; make it with `Optimized::of_model`, where they follow them",
                field.name
            ));
        }
        let shapes = self.shapes();
        let mut sets: BTreeMap<usize, (&str, usize)> = BTreeMap::new();
        for field in &self.fields {
            match shapes.get(&field.name).map(|[rows, _]| rows) {
                None => {
                    return wrong(format!(
                        "the model has no float parameter `{}`, which field `{}` names",
                        field.path, field.name
                    ));
                }
                Some(count) => {
                    let Some(set) = field.row_set else { continue };
                    let (first, expected) = sets.entry(set).or_insert((&field.name, *count));
                    if expected != count {
                        return wrong(format!(
                            "`{}` has {count} rows, `{first}` of the same row set {expected}; declare it in another set or as shared",
                            field.name
                        ));
                    }
                }
            }
        }
        Ok(())
    }

    /// The model.
    pub fn model(&self) -> &M {
        self.model.as_ref().expect(WHOLE)
    }

    /// Number of row edits so far. Gradients from before an edit belong to other rows.
    pub fn edits(&self) -> usize {
        self.edits
    }

    /// The model without its moments.
    pub fn into_model(self) -> M {
        self.model.expect(WHOLE)
    }

    /// The trained fields.
    pub fn fields(&self) -> &[Field] {
        &self.fields
    }

    #[cfg(test)]
    pub(crate) fn optimizer(&mut self, field: &str) -> &mut FieldOptimizer {
        self.optimizers.get_mut(field).expect("a field")
    }

    /// Value of a field, `[N, width]`, outside the autodiff graph.
    pub fn field(&self, name: &str) -> Option<Tensor<2>> {
        let mut found = None;
        self.visit(|field, value| {
            if field == name {
                found = Some(value);
            }
        });
        found
    }

    /// Values of fields on the host, each `[N][width]` flattened, in one transfer and in single
    /// precision.
    ///
    /// # Errors
    /// When the model has no such field, or the device fails.
    pub fn read<const K: usize>(&self, names: [&str; K]) -> Result<[Vec<f32>; K], OpError> {
        self.read_as(names)
    }

    /// The same in double precision.
    ///
    /// # Errors
    /// As those of [`read`](Self::read).
    pub fn read_f64<const K: usize>(&self, names: [&str; K]) -> Result<[Vec<f64>; K], OpError> {
        self.read_as(names)
    }

    fn read_as<E: Element, const K: usize>(
        &self,
        names: [&str; K],
    ) -> Result<[Vec<E>; K], OpError> {
        let mut values: BTreeMap<String, Tensor<2>> = BTreeMap::new();
        self.visit(|field, value| {
            if names.contains(&field) {
                values.insert(field.to_owned(), value);
            }
        });
        let missing = |name: &str| OpError::Argument {
            op: "Optimized::read",
            what: format!("the model has no field `{name}`"),
        };
        let tensors: Vec<Tensor<2>> = names
            .iter()
            .map(|name| values.get(*name).cloned().ok_or_else(|| missing(name)))
            .collect::<Result<_, _>>()?;
        let read = tensors
            .into_iter()
            .fold(Transaction::default(), Transaction::register);
        let read = read.try_execute().map_err(|error| OpError::Device {
            op: "Optimized::read",
            what: error.to_string(),
        })?;
        let mut read = read.into_iter();
        Ok(core::array::from_fn(|_| {
            let data = read.next().map(|data| data.convert::<E>());
            data.and_then(|data| data.try_into_vec().ok())
                .unwrap_or_default()
        }))
    }

    /// Takes the gradients of the fields from those of a backward pass.
    pub fn gradients(&self, gradients: &mut Gradients) -> FieldGradients {
        let mut taken = FieldGradients::new();
        let mut visitor = FieldVisitor::new(
            self.names(),
            GradientsOf {
                gradients,
                taken: &mut taken,
            },
        );
        self.model().visit(&mut visitor);
        taken
    }

    /// Steps every field that has a gradient. `how` returns its rate and what to do.
    ///
    /// # Errors
    /// When the shape of a gradient differs from its field's. No field has been stepped then.
    pub fn step(
        &mut self,
        mut gradients: FieldGradients,
        how: impl Fn(&Field) -> (f64, FieldStep),
    ) -> Result<(), OpError> {
        self.check_shapes("Optimized::step", &gradients)?;
        let mut steps = BTreeMap::new();
        for field in &self.fields {
            let Some(gradient) = gradients.remove(&field.name) else {
                continue;
            };
            let gradient = match self.waiting.remove(&field.name) {
                Some(waiting) => waiting + gradient,
                None => gradient,
            };
            match how(field) {
                (rate, FieldStep::Step(factor)) => {
                    steps.insert(field.name.clone(), (rate * factor, gradient));
                }
                (_, FieldStep::Accumulate) => {
                    self.waiting.insert(field.name.clone(), gradient);
                }
                (_, FieldStep::Skip) => {}
            }
        }
        self.version += 1;
        let names = self.names();
        let optimizers = &mut self.optimizers;
        change(&mut self.model, names, |name, value| {
            match (steps.remove(name), optimizers.get_mut(name)) {
                (Some((rate, gradient)), Some(optimizer)) => optimizer.step(rate, value, gradient),
                _ => value,
            }
        });
        Ok(())
    }

    fn check_shapes(&self, op: &'static str, tensors: &FieldGradients) -> Result<(), OpError> {
        let shapes = self.shapes();
        let wrong = tensors
            .iter()
            .find(|(name, tensor)| shapes.get(*name) != Some(&tensor.dims()));
        match wrong {
            None => Ok(()),
            Some((name, tensor)) => Err(OpError::Argument {
                op,
                what: format!(
                    "`{name}` has shape {:?}, {}",
                    tensor.dims(),
                    match shapes.get(name) {
                        Some(shape) => format!("the field of that name {shape:?}"),
                        None => "and is no field".to_owned(),
                    }
                ),
            }),
        }
    }

    /// Replaces the value `[N, width]` of a field by another of the same shape, keeping its
    /// moments.
    ///
    /// # Errors
    /// When the model has no such field, or the new value has another shape. The field is then
    /// unchanged.
    pub fn update(
        &mut self,
        field: &str,
        update: impl FnOnce(Tensor<2>) -> Tensor<2>,
    ) -> Result<(), OpError> {
        let value = self.field(field).ok_or_else(|| OpError::Argument {
            op: "Optimized::update",
            what: format!("the model has no field `{field}`"),
        })?;
        let updated = FieldGradients::from([(field.to_owned(), update(value))]);
        self.check_shapes("Optimized::update", &updated)?;
        self.version += 1;
        let (names, mut updated) = (self.names(), updated);
        change(&mut self.model, names, |name, value| {
            updated.remove(name).unwrap_or(value)
        });
        Ok(())
    }

    /// Resets all moments of a field.
    pub fn restart_moments(&mut self, field: &str) {
        if let Some(optimizer) = self.optimizers.get_mut(field) {
            optimizer.edit_rows(&MomentEdit::Restart);
        }
        self.waiting.remove(field);
    }

    /// Lowers every opacity to at most `opacity` and resets the moments of the logits (the opacity
    /// reset of 3DGS section 5.2).
    ///
    /// # Errors
    /// When the model has no opacity logits.
    pub fn clamp_opacities(&mut self, opacity: f64) -> Result<(), OpError> {
        let logit = logit(opacity);
        self.update("opacity_logits", |logits| logits.clamp_max(logit))?;
        self.restart_moments("opacity_logits");
        Ok(())
    }

    fn shapes(&self) -> BTreeMap<String, [usize; 2]> {
        let mut shapes = BTreeMap::new();
        self.visit(|name, value| {
            shapes.insert(name.to_owned(), value.dims());
        });
        shapes
    }

    /// Names of the float parameters that are not fields, by path.
    fn other_names(&self) -> HashMap<String, String> {
        let mut paths = Paths::default();
        self.model().visit(&mut paths);
        let fields = self.names();
        let others = (paths.found.into_iter()).filter(|path| !fields.contains_key(path));
        others
            .map(|path| {
                let name = format!("{FIXED}/{}", path.replace('.', "/"));
                (path, name)
            })
            .collect()
    }

    fn names(&self) -> HashMap<String, String> {
        let names = self.fields.iter();
        names
            .map(|field| (field.path.clone(), field.name.clone()))
            .collect()
    }

    fn visit(&self, visit: impl FnMut(&str, Tensor<2>)) {
        let mut visitor = FieldVisitor::new(self.names(), ValuesOf(visit));
        self.model().visit(&mut visitor);
    }
}

/// Prefix under which parameters that are not fields are saved.
const FIXED: &str = "fixed";
const WHOLE: &str = "the model is put back after every change";
