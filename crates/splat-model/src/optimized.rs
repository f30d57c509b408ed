//! A model and the optimisers of its fields, stepped and edited together.

use std::collections::{BTreeMap, HashMap};

use burn::module::{Module, ModuleMapper, ModuleVisitor, Param};
use burn::tensor::{Device, Gradients, Int, Tensor, TensorData, Transaction};
use splat_data::SceneScale;
use splat_ops::{AdamRows, OpError};

use crate::field::Field;
use crate::optimizer::{FieldOptimizer, MomentEdit, SplatAdam, StateRecord};
use crate::rows::{FieldChanges, Moments, RowEdit};
use crate::{LearningRates, SplatModel};

/// Gradients by the name of the field, each `[N, width]`: what is beyond the first dimension is flattened.
pub type FieldGradients = BTreeMap<String, Tensor<2>>;

/// What the optimiser does with a field in a step.
#[derive(Debug, Clone, Copy, PartialEq)]
pub enum FieldStep {
    /// A step, with the field's rate times this factor.
    Step(f64),
    /// None; the gradient is added to that of the next step.
    Accumulate,
    /// None; the gradient is forgotten.
    Skip,
}

/// A model, and for each of its fields an optimiser that owns the field's moments.
///
/// Rows of the model are edited here only, so that moments always belong to the rows beside them.
#[derive(Debug)]
pub struct Optimized<M> {
    /// Taken out while it is changed.
    model: Option<M>,
    fields: Vec<Field>,
    optimizers: BTreeMap<String, FieldOptimizer>,
    /// Gradients that wait for a step.
    waiting: FieldGradients,
}

impl<M: Module> Optimized<M> {
    /// A model, with an optimiser for each of its fields.
    ///
    /// # Errors
    /// When the model has no parameter of a field's path, or two fields share a name.
    pub fn new(
        model: M,
        fields: Vec<Field>,
        optimizer: impl Fn(&Field) -> FieldOptimizer,
    ) -> Result<Self, OpError> {
        let optimizers = (fields.iter())
            .map(|field| (field.name.clone(), optimizer(field)))
            .collect::<BTreeMap<_, _>>();
        let trained = Self {
            model: Some(model),
            fields,
            optimizers,
            waiting: FieldGradients::new(),
        };
        trained.check_fields()?;
        Ok(trained)
    }

    /// A model with [`SplatAdam`] for each of its fields, stepping `rows`.
    ///
    /// # Errors
    /// As those of [`new`](Self::new).
    pub fn with_adam(
        model: M,
        rates: &LearningRates,
        rows: AdamRows,
        scene: SceneScale,
    ) -> Result<Self, OpError>
    where
        M: SplatModel,
    {
        let fields = model.fields(rates);
        Self::new(model, fields, |field| {
            SplatAdam::of_field(field, rows, scene).into()
        })
    }

    /// A module whose float parameters are all trained with one learning rate, and have no row per Gaussian: what rides
    /// along with a model.
    ///
    /// # Errors
    /// As those of [`new`](Self::new).
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
        if let Some(field) = self.fields.iter().find(|field| field.name.contains('.')) {
            return wrong(format!(
                "the name `{}` has a dot, which separates names in checkpoints",
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

    /// The model without its moments.
    pub fn into_model(self) -> M {
        self.model.expect(WHOLE)
    }

    /// The fields that are trained.
    pub fn fields(&self) -> &[Field] {
        &self.fields
    }

    /// The value of a field, `[N, width]`, outside of the autodiff graph.
    pub fn field(&self, name: &str) -> Option<Tensor<2>> {
        let mut found = None;
        self.visit(|field, value| {
            if field == name {
                found = Some(value);
            }
        });
        found
    }

    /// The values of fields on the host, each `[N][width]` flattened, in one transfer.
    ///
    /// # Errors
    /// When the model has no such field, or the device fails.
    pub fn read<const K: usize>(&self, names: [&str; K]) -> Result<[Vec<f32>; K], OpError> {
        let mut values = BTreeMap::new();
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
            .map(|name| values.remove(*name).ok_or_else(|| missing(name)))
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
            let data = read.next().map(|data| data.convert::<f32>());
            data.and_then(|data| data.try_into_vec().ok())
                .unwrap_or_default()
        }))
    }

    /// Takes the gradients of the fields out of those of a backward pass.
    pub fn gradients(&self, gradients: &mut Gradients) -> FieldGradients {
        let mut taken = FieldGradients::new();
        let mut visitor = FieldVisitor {
            names: self.names(),
            path: Vec::new(),
            visit: GradientsOf {
                gradients,
                taken: &mut taken,
            },
        };
        self.model().visit(&mut visitor);
        taken
    }

    /// Steps every field that has a gradient, as `how` says: its rate, and what is to be done.
    pub fn step(
        &mut self,
        mut gradients: FieldGradients,
        how: impl Fn(&Field) -> (f64, FieldStep),
    ) {
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
        let names = self.names();
        let optimizers = &mut self.optimizers;
        change(&mut self.model, names, |name, value| {
            match (steps.remove(name), optimizers.get_mut(name)) {
                (Some((rate, gradient)), Some(optimizer)) => optimizer.step(rate, value, gradient),
                _ => value,
            }
        });
    }

    /// Edits the rows of every field of a row set, and the moments with them: a gather per field on the device.
    /// Parameters keep their ids.
    ///
    /// # Errors
    /// When the edit names an old row or a field that there is not, or values of another width.
    pub fn edit_rows(&mut self, edit: &RowEdit) -> Result<(), OpError> {
        self.check_edit(edit)?;
        let device = match self
            .fields
            .iter()
            .find(|field| field.row_set == Some(edit.row_set()))
        {
            Some(field) => match self.field(&field.name) {
                Some(value) => value.device(),
                None => return Ok(()),
            },
            None => return Ok(()),
        };
        let n = edit.len();
        let sources: Vec<i32> = edit.sources().iter().map(|row| *row as i32).collect();
        let keep: Vec<f32> = edit
            .moments()
            .iter()
            .map(|moments| f32::from(u8::from(*moments == Moments::Keep)))
            .collect();
        let source = Tensor::<1, Int>::from_data(TensorData::new(sources, [n]), &device);
        let keep = Tensor::<1>::from_data(TensorData::new(keep, [n]), &device);
        let mut changes = edit.changes();
        let edited: Vec<String> = self
            .fields
            .iter()
            .filter(|field| field.row_set == Some(edit.row_set()))
            .map(|field| field.name.clone())
            .collect();
        let names = self.names();
        change(&mut self.model, names, |name, value| {
            if !edited.iter().any(|field| field == name) {
                return value;
            }
            let value = value.select(0, source.clone());
            match changes.remove(name) {
                Some(changes) => changed(value, changes),
                None => value,
            }
        });
        let moments = MomentEdit::Gather { source, keep };
        for field in &edited {
            if let Some(optimizer) = self.optimizers.get_mut(field) {
                optimizer.edit_rows(&moments);
            }
            if let Some(waiting) = self.waiting.remove(field) {
                self.waiting.insert(field.clone(), moments.apply(waiting));
            }
        }
        Ok(())
    }

    /// Every row and width of an edit, before anything is changed.
    fn check_edit(&self, edit: &RowEdit) -> Result<(), OpError> {
        let wrong = |what: String| {
            Err(OpError::Argument {
                op: "Optimized::edit_rows",
                what,
            })
        };
        let shapes = self.shapes();
        let in_set = |field: &&Field| field.row_set == Some(edit.row_set());
        for field in self.fields.iter().filter(in_set) {
            let [rows, _] = shapes[&field.name];
            let beyond = |source: &u32| *source as usize >= rows;
            if let Some(index) = edit.sources().iter().position(beyond) {
                return wrong(format!(
                    "new row {index} is made from row {} of `{}`, which has {rows}",
                    edit.sources()[index],
                    field.name
                ));
            }
        }
        for (name, changes) in edit.changes() {
            let known = self
                .fields
                .iter()
                .filter(in_set)
                .any(|field| field.name == name);
            if !known {
                return wrong(format!(
                    "it changes `{name}`, which is no field of the row set"
                ));
            }
            let [_, width] = shapes[name];
            let fits = changes
                .offsets
                .as_ref()
                .is_none_or(|all| all.len() == width * edit.len())
                && changes.set_values.len() == width * changes.set_rows.len();
            if !fits {
                return wrong(format!("values for `{name}` must be {width} a row"));
            }
        }
        Ok(())
    }

    /// Replaces the value `[N, width]` of a field, of the same shape, and leaves its moments.
    pub fn update(&mut self, field: &str, update: impl FnOnce(Tensor<2>) -> Tensor<2>) {
        let names = self.names();
        let mut update = Some(update);
        change(&mut self.model, names, |name, value| {
            match update.take_if(|_| name == field) {
                Some(update) => update(value),
                None => value,
            }
        });
    }

    /// Lets all moments of a field start anew.
    pub fn restart_moments(&mut self, field: &str) {
        if let Some(optimizer) = self.optimizers.get_mut(field) {
            optimizer.edit_rows(&MomentEdit::Restart);
        }
        self.waiting.remove(field);
    }

    /// Lowers every opacity to at most `opacity` and lets the moments of the logits start anew (the opacity reset of 3DGS
    /// section 5.2).
    pub fn clamp_opacities(&mut self, opacity: f64) {
        let logit = (opacity / (1.0 - opacity)).ln();
        self.update("opacity_logits", |logits| logits.clamp_max(logit));
        self.restart_moments("opacity_logits");
    }

    /// Values and optimiser states of all fields, on the host: value `means` is tensor `means`, a moment of it
    /// `means.moment_1`. Values are `[N, width]`.
    ///
    /// # Errors
    /// When the device fails.
    pub fn save(&self) -> Result<StateRecord, OpError> {
        let mut record = StateRecord::default();
        for field in &self.fields {
            let name = &field.name;
            let [values] = self.read([name.as_str()])?;
            let width = self.shapes()[name][1];
            let rows = values.len() / width.max(1);
            record
                .tensors
                .insert(name.clone(), TensorData::new(values, [rows, width]));
            let mut state = self.optimizers[name].save();
            if let Some(waiting) = self.waiting.get(name) {
                state.tensors.insert(WAITING.to_owned(), waiting.to_data());
            }
            let of = |leaf: String| format!("{name}.{leaf}");
            record.tensors.extend(
                state
                    .tensors
                    .into_iter()
                    .map(|(leaf, data)| (of(leaf), data)),
            );
            record.scalars.extend(
                state
                    .scalars
                    .into_iter()
                    .map(|(leaf, value)| (of(leaf), value)),
            );
        }
        Ok(record)
    }

    /// Puts back what [`save`](Self::save) gave, with any number of rows. Parameters keep their ids.
    ///
    /// # Errors
    /// What does not fit the model or its optimisers, naming the field; nothing is changed then but the state of
    /// optimisers.
    pub fn restore(&mut self, record: StateRecord, device: &Device) -> Result<(), String> {
        let mut fields = record.by_field();
        let shapes = self.shapes();
        let mut values = BTreeMap::new();
        let mut rows_of_set = BTreeMap::new();
        for field in &self.fields {
            let name = &field.name;
            let (value, mut state) = match fields.remove(name) {
                Some((Some(value), state)) => (value, state),
                _ => return Err(format!("`{name}` is missing")),
            };
            let [own_rows, width] = shapes[name];
            let rows = match (&value.shape()[..], field.row_set) {
                ([rows, found], Some(_)) if *found == width => *rows,
                ([rows, found], None) if [*rows, *found] == [own_rows, width] => *rows,
                (shape, _) => {
                    return Err(format!(
                        "`{name}` has shape {shape:?}, the model's has [{own_rows}, {width}]"
                    ));
                }
            };
            if let Some(set) = field.row_set {
                let first = *rows_of_set.entry(set).or_insert(rows);
                if first != rows {
                    return Err(format!("`{name}` has {rows} rows beside others of {first}"));
                }
            }
            if let Some(waiting) = state.tensors.remove(WAITING) {
                if waiting.shape()[..] != [rows, width] {
                    return Err(format!(
                        "the gradient of `{name}` has shape {:?}",
                        waiting.shape().to_vec()
                    ));
                }
                self.waiting
                    .insert(name.clone(), Tensor::from_data(waiting, device));
            }
            if let Some(optimizer) = self.optimizers.get_mut(name) {
                let restored = optimizer.restore(state, [rows, width], device);
                restored.map_err(|reason| format!("the optimiser of `{name}`: {reason}"))?;
            }
            values.insert(name.clone(), Tensor::from_data(value, device));
        }
        if let Some(name) = fields.keys().next() {
            return Err(format!("`{name}` is no field of the model"));
        }
        let names = self.names();
        change(&mut self.model, names, |name, value| {
            values.remove(name).unwrap_or(value)
        });
        Ok(())
    }

    fn shapes(&self) -> BTreeMap<String, [usize; 2]> {
        let mut shapes = BTreeMap::new();
        self.visit(|name, value| {
            shapes.insert(name.to_owned(), value.dims());
        });
        shapes
    }

    fn names(&self) -> HashMap<String, String> {
        let names = self.fields.iter();
        names
            .map(|field| (field.path.clone(), field.name.clone()))
            .collect()
    }

    fn visit(&self, visit: impl FnMut(&str, Tensor<2>)) {
        let mut visitor = FieldVisitor {
            names: self.names(),
            path: Vec::new(),
            visit: ValuesOf(visit),
        };
        self.model().visit(&mut visitor);
    }
}

const WHOLE: &str = "the model is put back after every change";
/// Name of a gradient that waits for a step, beside the moments.
const WAITING: &str = "waiting_gradient";

/// Gathered rows with what the edit adds to them and puts in their place.
fn changed(value: Tensor<2>, changes: FieldChanges) -> Tensor<2> {
    let device = value.device();
    let [n, width] = value.dims();
    let value = match changes.offsets {
        Some(offsets) => value + Tensor::from_data(TensorData::new(offsets, [n, width]), &device),
        None => value,
    };
    if changes.set_rows.is_empty() {
        return value;
    }
    let mut set = vec![0.0; n * width];
    let mut is_set = vec![false; n * width];
    for (row, values) in changes
        .set_rows
        .iter()
        .zip(changes.set_values.chunks(width.max(1)))
    {
        let row = row * width..(row + 1) * width;
        set[row.clone()].copy_from_slice(values);
        is_set[row].fill(true);
    }
    let set = Tensor::from_data(TensorData::new(set, [n, width]), &device);
    let mask = Tensor::from_data(TensorData::new(is_set, [n, width]), &device);
    value.mask_where(mask, set)
}

/// `[N, ...]` as `[N, width]`.
fn flat<const D: usize>(value: Tensor<D>) -> Tensor<2> {
    let dims = value.dims();
    let width: usize = dims[1..].iter().product();
    // Burn's reshape reads a zero as "keep this dimension".
    value.reshape([dims[0], width])
}

/// Paths of all float parameters.
#[derive(Default)]
struct Paths {
    path: Vec<String>,
    found: Vec<String>,
}

impl ModuleVisitor for Paths {
    fn enter_module(&mut self, name: &str, _: &str) {
        self.path.push(name.to_owned());
    }

    fn exit_module(&mut self, _: &str, _: &str) {
        self.path.pop();
    }

    fn visit_float<const D: usize>(&mut self, _: &Param<Tensor<D>>) {
        self.found.push(self.path.join("."));
    }
}

/// What is done with a parameter of a field.
trait VisitField {
    fn visit<const D: usize>(&mut self, name: &str, param: &Param<Tensor<D>>);
}

struct FieldVisitor<V> {
    /// Names of fields by path.
    names: HashMap<String, String>,
    path: Vec<String>,
    visit: V,
}

impl<V: VisitField> ModuleVisitor for FieldVisitor<V> {
    fn enter_module(&mut self, name: &str, _: &str) {
        self.path.push(name.to_owned());
    }

    fn exit_module(&mut self, _: &str, _: &str) {
        self.path.pop();
    }

    fn visit_float<const D: usize>(&mut self, param: &Param<Tensor<D>>) {
        if let Some(name) = self.names.get(&self.path.join(".")) {
            self.visit.visit(name, param);
        }
    }
}

struct ValuesOf<F>(F);

impl<F: FnMut(&str, Tensor<2>)> VisitField for ValuesOf<F> {
    fn visit<const D: usize>(&mut self, name: &str, param: &Param<Tensor<D>>) {
        let value = param.val();
        let value = if value.device().is_autodiff() {
            value.inner()
        } else {
            value
        };
        (self.0)(name, flat(value));
    }
}

struct GradientsOf<'a> {
    gradients: &'a mut Gradients,
    taken: &'a mut FieldGradients,
}

impl VisitField for GradientsOf<'_> {
    fn visit<const D: usize>(&mut self, name: &str, param: &Param<Tensor<D>>) {
        if param.is_require_grad()
            && let Some(gradient) = param.val().grad_remove(self.gradients)
        {
            self.taken.insert(name.to_owned(), flat(gradient));
        }
    }
}

/// Maps the values of fields outside of the autodiff graph. While one is changed nothing else holds it, so that an
/// optimiser can write into its memory.
fn change<M: Module>(
    model: &mut Option<M>,
    names: HashMap<String, String>,
    map: impl FnMut(&str, Tensor<2>) -> Tensor<2>,
) {
    let mut mapper = FieldMapper {
        names,
        path: Vec::new(),
        map,
    };
    *model = model.take().map(|whole| whole.map(&mut mapper));
}

struct FieldMapper<F> {
    names: HashMap<String, String>,
    path: Vec<String>,
    map: F,
}

impl<F: FnMut(&str, Tensor<2>) -> Tensor<2>> ModuleMapper for FieldMapper<F> {
    fn enter_module(&mut self, name: &str, _: &str) {
        self.path.push(name.to_owned());
    }

    fn exit_module(&mut self, _: &str, _: &str) {
        self.path.pop();
    }

    fn map_float<const D: usize>(&mut self, param: Param<Tensor<D>>) -> Param<Tensor<D>> {
        let Some(name) = self.names.get(&self.path.join(".")) else {
            return param;
        };
        param.map(|value| {
            let (requires_grad, tracked) = (value.is_require_grad(), value.device().is_autodiff());
            let strategy = value.gradient_checkpointing_strategy();
            let mut dims = value.dims();
            let value = if tracked { value.inner() } else { value };
            let value = (self.map)(name, flat(value));
            dims[0] = value.dims()[0];
            let value = value.reshape(dims);
            if !tracked {
                return value;
            }
            let mut value = Tensor::from_inner(value);
            if let Some(strategy) = strategy {
                value = value.with_gradient_checkpointing_strategy(strategy);
            }
            value.set_require_grad(requires_grad)
        })
    }
}
