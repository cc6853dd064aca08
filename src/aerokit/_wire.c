/* The compiled wire: framing, decoding, encoding, checksums, and records of telemetry logs.

   The Python modules of aerokit.mavlink are the reference: this module has the same results, counters and errors. It
   calls the Python code for rare cases: noise, unknown messages, frames out of order, new senders and invalid values.

   The input may be hostile, so its length is checked before every read. The data is kept in immutable bytes objects,
   and this module owns a reference to them whenever it calls Python code. It reads and writes the fields of messages
   directly in the slots of their class. The offset of each slot is found once for each class (`slot_of`).

   The module uses only the limited API, so one binary serves all versions of Python from 3.10. Only constants are
   static; each interpreter has its own module state. Interpreters with their own GIL need a declaration of the API of
   3.12, and free-threaded ones have no limited API. Both use the Python code. */

#include <Python.h>
#include <float.h>
#include <stdint.h>
#include <string.h>
#include <structmember.h>

#define VERSION 2 /* must equal _VERSION in _internal/wire.py */

enum { MAGIC_V1 = 0xFE, MAGIC_V2 = 0xFD, SIGNED = 1, SIGNATURE = 13, HEADER = 9, MAX_PAYLOAD = 255, MAX_FRAME = 280 };

enum { FRAME, SOURCE, COUNTERS, CLASSES, FRAMER = CLASSES, TABLE, LAYOUT, TYPES };

typedef struct {
    PyTypeObject *types[TYPES];
    PyTypeObject *classes[CLASSES]; /* Python classes derived from the first `types`; NULL before `register` */
    PyObject *zero, *layout_name;
    uint16_t crc[8][256];
} State;

enum { STATE_OBJECTS = offsetof(State, crc) / sizeof(PyObject *) };

static unsigned u16(const uint8_t *at) { return (unsigned)(at[0] | at[1] << 8); }
static uint32_t u32(const uint8_t *at) { return u16(at) | (uint32_t)u16(at + 2) << 16; }
static uint64_t u64(const uint8_t *at) { return u32(at) | (uint64_t)u32(at + 4) << 32; }

static uint32_t message_id_of(const uint8_t *frame) {
    return frame[0] == MAGIC_V1 ? frame[5] : u16(frame + 7) | (uint32_t)frame[9] << 16;
}

static void put_little_endian(uint8_t *at, int size, uint64_t value) {
    for (int i = 0; i < size; i++, value >>= 8)
        at[i] = (uint8_t)value;
}

static PyObject *new_reference(PyObject *object) {
    Py_INCREF(object);
    return object;
}

static void free_object(PyObject *self) {
    PyTypeObject *type = Py_TYPE(self);
    ((freefunc)PyType_GetSlot(type, Py_tp_free))(self);
    Py_DECREF(type);
}

static int visit_all(PyObject **objects, int count, visitproc visit, void *arg) {
    for (int i = 0; i < count; i++)
        Py_VISIT(objects[i]);
    return 0;
}

static int clear_all(PyObject **objects, int count) {
    for (int i = 0; i < count; i++)
        Py_CLEAR(objects[i]);
    return 0;
}

/* Define garbage collection of a type. Its instances own ``memory`` and ``count`` objects, the first in ``first``. */
#define OWNER(name, Type, first, count)                                                                                \
    static int name##_traverse(PyObject *self, visitproc visit, void *arg) {                                           \
        Py_VISIT(Py_TYPE(self));                                                                                       \
        return visit_all(&((Type *)self)->first, count, visit, arg);                                                   \
    }                                                                                                                  \
    static int name##_clear(PyObject *self) { return clear_all(&((Type *)self)->first, count); }                       \
    static void name##_dealloc(PyObject *self) {                                                                       \
        PyObject_GC_UnTrack(self);                                                                                     \
        name##_clear(self);                                                                                            \
        PyMem_Free(((Type *)self)->memory);                                                                            \
        free_object(self);                                                                                             \
    }

/* ------------------------------------------------------------------------------------------- checksum */

static void fill_crc_tables(State *state) {
    for (int row = 0; row < 8; row++) /* the entries of a byte that is followed by ``row`` zeros */
        for (int byte = 0; byte < 256; byte++) {
            unsigned crc = (unsigned)byte;
            for (int bit = 0; bit < 8 * (row + 1); bit++)
                crc = crc & 1 ? crc >> 1 ^ 0x8408 : crc >> 1;
            state->crc[row][byte] = (uint16_t)crc;
        }
}

static unsigned x25(const State *state, const uint8_t *data, Py_ssize_t size, unsigned crc) {
    const uint16_t(*t)[256] = state->crc;
    for (; size >= 8; data += 8, size -= 8) {
        crc ^= u16(data);
        crc = t[7][crc & 0xFF] ^ t[6][crc >> 8] ^ t[5][data[2]] ^ t[4][data[3]] ^ t[3][data[4]] ^ t[2][data[5]] ^
              t[1][data[6]] ^ t[0][data[7]];
    }
    for (; size > 0; data++, size--)
        crc = crc >> 8 ^ t[0][(crc ^ *data) & 0xFF];
    return crc;
}

/* Return the checksum of a frame, which covers all bytes after the magic byte, and then CRC_EXTRA. */
static unsigned x25_of_frame(const State *state, const uint8_t *frame, Py_ssize_t size, uint8_t extra) {
    return x25(state, &extra, 1, x25(state, frame + 1, size - 1, 0xFFFF));
}

/* x25(data): implements `aerokit.mavlink.frame.x25`. */
static PyObject *wire_x25(PyObject *module, PyObject *object) {
    PyObject *data = PyBytes_FromObject(object);
    if (data == NULL)
        return NULL;
    unsigned crc = x25(PyModule_GetState(module), (uint8_t *)PyBytes_AsString(data), PyBytes_Size(data), 0xFFFF);
    Py_DECREF(data);
    return PyLong_FromLong((long)crc);
}

/* ---------------------------------------------------------------- fields of frames, senders, counters */

typedef struct {
    PyObject_HEAD
    PyObject *body, *received_at, *raw;
    unsigned int message_id;
    unsigned short checksum;
    unsigned char system_id, component_id;
} Frame;

#define MEMBER(name, kind, Type, member) {name, kind, offsetof(Type, member), 0, NULL}
static PyMemberDef frame_members[] = {
    MEMBER("_body", T_OBJECT_EX, Frame, body),       MEMBER("received_at", T_OBJECT_EX, Frame, received_at),
    MEMBER("_raw", T_OBJECT_EX, Frame, raw),         MEMBER("message_id", T_UINT, Frame, message_id),
    MEMBER("checksum", T_USHORT, Frame, checksum),   MEMBER("system_id", T_UBYTE, Frame, system_id),
    MEMBER("component_id", T_UBYTE, Frame, component_id), {0},
};

/* Find the payload in `_raw`. Return its length, or -1 if `_raw` does not contain a whole frame. */
static int find_payload(const Frame *frame, const uint8_t **payload) {
    if (frame->raw == NULL || !PyBytes_CheckExact(frame->raw))
        return -1;
    const uint8_t *raw = (const uint8_t *)PyBytes_AsString(frame->raw); /* a zero byte follows the last one */
    Py_ssize_t size = PyBytes_Size(frame->raw), header = raw[0] == MAGIC_V1 ? 6 : 10;
    *payload = raw + header;
    return size > header && size >= header + raw[1] + 2 ? raw[1] : -1;
}

/* Return `Frame.body`. It is created when it is first read, because most frames are only decoded. */
static PyObject *frame_body(PyObject *object, void *closure) {
    Frame *frame = (Frame *)object;
    const uint8_t *payload;
    int length = frame->body == NULL ? find_payload(frame, &payload) : -1;
    if (length >= 0) {
        const uint8_t *raw = (const uint8_t *)PyBytes_AsString(frame->raw);
        uint8_t body_v1[HEADER + MAX_PAYLOAD] = {raw[1], 0, 0, raw[2], raw[3], raw[4], raw[5], 0, 0};
        memcpy(body_v1 + HEADER, payload, (size_t)length);
        frame->body = PyBytes_FromStringAndSize((char *)(raw[0] == MAGIC_V1 ? body_v1 : raw + 1), HEADER + length);
    }
    Py_XINCREF(frame->body);
    return frame->body != NULL || PyErr_Occurred() ? frame->body : PyErr_Format(PyExc_AttributeError, "body");
}

static PyGetSetDef frame_getters[] = {{"body", frame_body, NULL, NULL, NULL}, {0}};

static void frame_dealloc(PyObject *self) {
    clear_all(&((Frame *)self)->body, 3);
    free_object(self);
}

/* Create a frame from its ``size`` bytes at ``raw``. ``whole`` is a bytes object with the same content, or NULL. */
static PyObject *make_frame(State *state, const uint8_t *raw, Py_ssize_t size, PyObject *received_at, PyObject *whole) {
    Frame *frame = (Frame *)PyType_GenericAlloc(state->classes[FRAME], 0);
    if (frame == NULL)
        return NULL;
    int is_v1 = raw[0] == MAGIC_V1;
    frame->message_id = message_id_of(raw);
    frame->checksum = (unsigned short)u16(raw + (is_v1 ? 6 : 10) + raw[1]);
    frame->system_id = raw[is_v1 ? 3 : 5];
    frame->component_id = raw[is_v1 ? 4 : 6];
    frame->received_at = new_reference(received_at);
    frame->raw = whole != NULL ? new_reference(whole) : PyBytes_FromStringAndSize((const char *)raw, size);
    if (frame->raw == NULL) {
        Py_DECREF(frame);
        return NULL;
    }
    return (PyObject *)frame;
}

/* register(which, class): set the class of frames (0), senders (1) or counters (2). */
static PyObject *wire_register(PyObject *module, PyObject *args) {
    State *state = PyModule_GetState(module);
    PyObject *class;
    int which;
    if (!PyArg_ParseTuple(args, "iO!", &which, &PyType_Type, &class))
        return NULL;
    if (which < 0 || which >= CLASSES || !PyType_IsSubtype((PyTypeObject *)class, state->types[which]))
        return PyErr_Format(PyExc_TypeError, "%R is not derived from its fields", class);
    Py_XDECREF(state->classes[which]);
    state->classes[which] = (PyTypeObject *)new_reference(class);
    Py_RETURN_NONE;
}

typedef struct {
    PyObject_HEAD
    unsigned long long number; /* `SourceStatistics.expected`, or `FramerStatistics.bytes` */
} Number;

static PyMemberDef source_members[] = {MEMBER("expected", T_ULONGLONG, Number, number), {0}};
static PyMemberDef counter_members[] = {MEMBER("bytes", T_ULONGLONG, Number, number), {0}};

/* ------------------------------------------------------------- layouts of message classes, and decoding */

typedef struct {
    int kind;        /* "s" for a text, "p" for bytes, otherwise the code in Python's struct */
    int count;       /* number of elements; 0 if the field is not an array */
    int offset, size; /* position in the payload; size of one element in bytes */
    Py_ssize_t slot; /* offset of the slot in the message object */
} Field;

typedef struct {
    PyObject_HEAD
    PyObject *message_class;
    Py_ssize_t frame_slot;
    Field *memory; /* the fields in wire order */
    int field_count, id, crc_extra, length, base_length;
    State *state; /* state of the module, which the type keeps alive */
} Layout;

static PyObject **at_slot(PyObject *object, Py_ssize_t slot) { return (PyObject **)(void *)((char *)object + slot); }

OWNER(layout, Layout, message_class, 1)

/* Find the offset of a slot by storing a probe object in it. Return 0 if it cannot be found, or -1 after an error. */
static Py_ssize_t slot_of(PyObject *message_class, PyObject *name) {
    PyObject *size = PyObject_GetAttrString(message_class, "__basicsize__");
    Py_ssize_t end = size == NULL ? -1 : PyLong_AsSsize_t(size), found = -1;
    PyObject *message = end < 0 ? NULL : PyType_GenericAlloc((PyTypeObject *)message_class, 0);
    PyObject *probe = message == NULL ? NULL : PyObject_CallNoArgs((PyObject *)&PyBaseObject_Type);
    if (probe != NULL && PyObject_SetAttr(message, name, probe) == 0) {
        found = 0;
        for (Py_ssize_t at = sizeof(PyObject); at + (Py_ssize_t)sizeof(PyObject *) <= end; at += sizeof(PyObject *))
            if (*at_slot(message, at) == probe)
                found = found == 0 ? at : end;
        found = found == end ? 0 : found;
    }
    Py_XDECREF(size);
    Py_XDECREF(message);
    Py_XDECREF(probe);
    return found;
}

static int size_of(int kind) {
    return strchr("bBsp", kind) ? 1 : strchr("hH", kind) ? 2 : strchr("iIf", kind) ? 4 : strchr("qQd", kind) ? 8 : 0;
}

/* Fill the fields. Return 1, 0 if only Python code can handle the class, or -1 after an error. */
static int fill_layout(Layout *self, PyObject *rows) {
    int count = (int)PyTuple_Size(rows), at = 0;
    PyObject *name = PyUnicode_FromString("received_frame");
    self->frame_slot = name == NULL ? -1 : slot_of(self->message_class, name);
    Py_XDECREF(name);
    self->memory = PyMem_Calloc((size_t)count + 1, sizeof(Field));
    if (self->memory == NULL)
        PyErr_NoMemory();
    if (self->frame_slot <= 0 || self->memory == NULL)
        return PyErr_Occurred() ? -1 : 0;
    for (; self->field_count < count; self->field_count++) {
        Field *field = &self->memory[self->field_count];
        if (!PyArg_ParseTuple(PyTuple_GetItem(rows, self->field_count), "UCi", &name, &field->kind, &field->count))
            return -1;
        field->size = field->kind ? size_of(field->kind) : 0;
        field->offset = at;
        field->slot = slot_of(self->message_class, name);
        if (field->slot <= 0 || field->size == 0 || field->count < 0 || field->count > MAX_PAYLOAD)
            return field->slot < 0 ? -1 : 0;
        at += field->size * (field->count ? field->count : 1);
        if (at > MAX_PAYLOAD)
            return 0;
    }
    return at == self->length && self->base_length >= 0 && self->base_length <= at && self->id >= 0 &&
           self->id <= 0xFFFFFF && self->crc_extra >= 0 && self->crc_extra <= 0xFF;
}

/* layout(class, id, CRC_EXTRA, length, base length, ((name, kind, count), …)): None if the class needs Python code. */
static PyObject *wire_layout(PyObject *module, PyObject *args) {
    State *state = PyModule_GetState(module);
    PyObject *message_class, *rows;
    Layout *self = (Layout *)PyType_GenericAlloc(state->types[LAYOUT], 0);
    int result = -1;
    if (self != NULL && PyArg_ParseTuple(args, "O!iiiiO!", &PyType_Type, &message_class, &self->id, &self->crc_extra,
                                         &self->length, &self->base_length, &PyTuple_Type, &rows)) {
        self->message_class = new_reference(message_class);
        self->state = state;
        result = fill_layout(self, rows);
    }
    if (result > 0)
        return (PyObject *)self;
    Py_XDECREF(self);
    return result < 0 ? NULL : new_reference(Py_None);
}

typedef union { float number; uint32_t bits; } Single;
typedef union { double number; uint64_t bits; } Double;

/* Return the number at ``at``; NULL without an exception for a signalling NaN, because Python versions differ there. */
static PyObject *decode_number(int kind, const uint8_t *at) {
    switch (kind) {
    case 'b': return PyLong_FromLong((int8_t)at[0]);
    case 'B': return PyLong_FromLong(at[0]);
    case 'h': return PyLong_FromLong((int16_t)u16(at));
    case 'H': return PyLong_FromLong((long)u16(at));
    case 'i': return PyLong_FromLong((int32_t)u32(at));
    case 'I': return PyLong_FromLongLong(u32(at));
    case 'q': return PyLong_FromLongLong((int64_t)u64(at));
    case 'Q': return PyLong_FromUnsignedLongLong(u64(at));
    case 'f':
        if ((u32(at) & 0x7FC00000) == 0x7F800000 && u32(at) & 0x3FFFFF)
            return NULL;
        return PyFloat_FromDouble((Single){.bits = u32(at)}.number);
    default: return PyFloat_FromDouble((Double){.bits = u64(at)}.number);
    }
}

static PyObject *decode_field(const Field *field, const uint8_t *payload) {
    const uint8_t *at = payload + field->offset;
    if (field->kind == 's' || field->kind == 'p') {
        size_t size = field->count ? (size_t)field->count : 1;
        if (field->kind == 'p')
            return PyBytes_FromStringAndSize((const char *)at, (Py_ssize_t)size);
        const uint8_t *nul = memchr(at, 0, size);
        return PyUnicode_DecodeUTF8((const char *)at, nul == NULL ? (Py_ssize_t)size : nul - at, "replace");
    }
    if (!field->count)
        return decode_number(field->kind, at);
    PyObject *items = PyTuple_New(field->count);
    for (int i = 0; items != NULL && i < field->count; i++) {
        PyObject *item = decode_number(field->kind, at + i * field->size);
        if (item == NULL)
            Py_CLEAR(items);
        else
            PyTuple_SetItem(items, i, item);
    }
    return items;
}

/* decode(frame): decode a frame of this class. Frames without `_raw` and invalid values are left to Python code. */
static PyObject *layout_decode(PyObject *object, PyObject *frame) {
    Layout *self = (Layout *)object;
    const uint8_t *payload;
    uint8_t restored[MAX_PAYLOAD];
    PyObject *message = NULL, *raw = NULL, *value;
    int size = Py_TYPE(frame) == self->state->classes[FRAME] ? find_payload((Frame *)frame, &payload) : -1;
    if (size < 0 || self->message_class == NULL)
        goto python;
    if (size < self->length) { /* the sender truncated trailing zeros */
        memset(restored, 0, (size_t)self->length);
        memcpy(restored, payload, (size_t)size);
        payload = restored;
    }
    message = PyType_GenericAlloc((PyTypeObject *)self->message_class, 0);
    if (message == NULL)
        return NULL;
    raw = new_reference(((Frame *)frame)->raw); /* keeps the payload alive */
    *at_slot(message, self->frame_slot) = new_reference(frame);
    for (int i = 0; i < self->field_count; i++) {
        value = *at_slot(message, self->memory[i].slot) = decode_field(&self->memory[i], payload);
        if (value == NULL)
            goto python;
    }
    Py_DECREF(raw);
    return message;
python:
    Py_XDECREF(message);
    Py_XDECREF(raw);
    if (PyErr_Occurred() || self->message_class == NULL) /* the class is NULL while the layout is being destroyed */
        return PyErr_Occurred() ? NULL : PyErr_NoMemory();
    value = PyObject_GetAttrString(frame, "body");
    return value == NULL ? NULL : PyObject_CallMethod(self->message_class, "decode_body", "NO", value, frame);
}

/* ------------------------------------------------------------------------------------------- encoding */

/* Encode one number. Return 1, or 0 if Python code must convert the value or raise the error for it. */
static int encode_number(int kind, int size, PyObject *value, uint8_t *at) {
    if (kind == 'f' || kind == 'd') {
        if (!PyFloat_Check(value) && !PyLong_Check(value))
            return 0;
        double number = PyFloat_AsDouble(value);
        if (PyErr_Occurred())
            return 0;
        int is_finite = number - number == 0; /* Python code encodes NaN and numbers that may be too large */
        if (kind == 'f' && (number != number || (is_finite && (number > FLT_MAX || number < -FLT_MAX))))
            return 0;
        put_little_endian(at, size, kind == 'f' ? (Single){(float)number}.bits : (Double){number}.bits);
        return 1;
    }
    if (!PyLong_Check(value))
        return 0;
    if (kind == 'Q') {
        unsigned long long number = PyLong_AsUnsignedLongLong(value);
        put_little_endian(at, 8, number);
        return !PyErr_Occurred();
    }
    int overflow;
    long long number = PyLong_AsLongLongAndOverflow(value, &overflow);
    if (overflow || PyErr_Occurred())
        return 0;
    int is_signed = strchr("bhiq", kind) != NULL;
    long long limit = kind == 'q' ? 0 : 1LL << (8 * size - is_signed);
    put_little_endian(at, size, (uint64_t)number);
    return !limit || (number < limit && number >= (is_signed ? -limit : 0));
}

/* Encode the value of a field to bytes that are all zero. Return 1, or 0 if Python code must encode the message. */
static int encode_field(const Field *field, PyObject *value, uint8_t *at) {
    Py_ssize_t size = field->count ? field->count : 1, length = 0;
    const char *text = NULL;
    if (field->kind == 's' || field->kind == 'p') {
        if (field->kind == 's' && PyUnicode_CheckExact(value))
            text = PyUnicode_AsUTF8AndSize(value, &length);
        else if (field->kind == 'p' && PyBytes_CheckExact(value) && (length = PyBytes_Size(value)) <= size)
            text = PyBytes_AsString(value);
        if (text == NULL || length > size)
            return 0;
        memcpy(at, text, (size_t)length);
        return 1;
    }
    if (!field->count)
        return encode_number(field->kind, field->size, value, at);
    if (!PyTuple_CheckExact(value) || PyTuple_Size(value) > size) /* converting an item could change a list */
        return 0;
    for (Py_ssize_t i = 0; i < PyTuple_Size(value); i++)
        if (!encode_number(field->kind, field->size, PyTuple_GetItem(value, i), at + i * field->size))
            return 0;
    return 1;
}

/* Encode a message to ``frame`` (MAX_FRAME bytes). Return its size without the signature, or 0 if Python code must. */
static Py_ssize_t encode(State *state, PyObject *message, int version, const uint8_t head[4], uint8_t *frame) {
    Py_ssize_t total = 0;
    Layout *layout = (Layout *)PyObject_GetAttr((PyObject *)Py_TYPE(message), state->layout_name);
    if (layout == NULL || Py_TYPE(layout) != state->types[LAYOUT] ||
        layout->message_class != (PyObject *)Py_TYPE(message) || (version == 1 && layout->id > 0xFF))
        goto done;
    int header = version == 1 ? 6 : 10;
    uint8_t *payload = frame + header;
    memset(frame, 0, MAX_FRAME);
    for (int i = 0; i < layout->field_count; i++) {
        const Field *field = &layout->memory[i];
        PyObject *value = *at_slot(message, field->slot);
        if (value == NULL)
            goto done;
        Py_INCREF(value);
        int is_encoded = encode_field(field, value, payload + field->offset);
        Py_DECREF(value);
        if (!is_encoded)
            goto done;
    }
    int length = version == 1 ? layout->base_length : layout->length;
    while (version != 1 && length > 1 && payload[length - 1] == 0)
        length--;
    frame[0] = version == 1 ? MAGIC_V1 : MAGIC_V2;
    frame[1] = (uint8_t)length;
    frame[2] = version == 1 ? 0 : head[0];
    memcpy(frame + (version == 1 ? 2 : 4), head + 1, 3);
    put_little_endian(frame + (version == 1 ? 5 : 7), version == 1 ? 1 : 3, (uint64_t)layout->id);
    unsigned crc = x25_of_frame(state, frame, header + length, (uint8_t)layout->crc_extra);
    put_little_endian(payload + length, 2, crc);
    total = header + length + 2;
done:
    Py_XDECREF(layout);
    return total;
}

/* encode_frame(message, version, flags, sequence, system_id, component_id): return a whole frame without its signature,
   or None if Python code must encode the message or raise the error. */
static PyObject *wire_encode_frame(PyObject *module, PyObject *args) {
    uint8_t head[4], frame[MAX_FRAME];
    PyObject *message = NULL;
    int version = 2;
    if (!PyArg_ParseTuple(args, "Oibbbb", &message, &version, &head[0], &head[1], &head[2], &head[3]))
        return NULL;
    Py_ssize_t size = encode(PyModule_GetState(module), message, version, head, frame);
    if (size)
        return PyBytes_FromStringAndSize((char *)frame, size);
    if (PyErr_Occurred() && !PyErr_ExceptionMatches(PyExc_Exception))
        return NULL;
    PyErr_Clear();
    Py_RETURN_NONE;
}

/* ------------------------------------------------------------------------------------------- dialects */

typedef struct {
    PyObject *id, *layout; /* `number` as a Python int, NULL in a free row; NULL before the first message of the class */
    uint32_t number;       /* message id */
    int extra, base_length, length;
} Row;

typedef struct {
    PyObject_HEAD
    PyObject *owned; /* a list of the objects to which the rows refer */
    PyObject *find_layout, *decode_in_python;
    Row *memory; /* a hash table by message id, at most half full */
    uint32_t mask;
    State *state; /* state of the module, which the type keeps alive */
} Table;

OWNER(table, Table, owned, 3)

/* Return the row of a message id or, if there is none, the free row where it belongs. */
static Row *row_of(const Table *self, uint32_t number) {
    uint32_t at = number * 2654435761u >> 12 & self->mask;
    while (self->memory[at].id != NULL && self->memory[at].number != number)
        at = (at + 1) & self->mask;
    return &self->memory[at];
}

/* Return the row of a message id. Return NULL if the message is unknown, or if the table is being destroyed. */
static Row *find_row(const Table *self, uint32_t number) {
    Row *row = row_of(self, number);
    return row->id != NULL && self->owned != NULL ? row : NULL;
}

static int add_row(Table *self, PyObject *id, PyObject *row) {
    Row new = {.id = id};
    unsigned long number = PyLong_AsUnsignedLong(id);
    if (PyErr_Occurred() || !PyArg_ParseTuple(row, "iii", &new.extra, &new.base_length, &new.length))
        return -1;
    if (number > 0xFFFFFF) /* message ids have 24 bits, so no frame has this id */
        return 0;
    new.number = (uint32_t)number;
    *row_of(self, new.number) = new;
    return PyList_Append(self->owned, id);
}

/* table(rows, find_layout, decode_in_python): return the table of the messages of a dialect. */
static PyObject *wire_table(PyObject *module, PyObject *args) {
    State *state = PyModule_GetState(module);
    PyObject *rows, *find_layout, *decode_in_python, *id, *row;
    if (!PyArg_ParseTuple(args, "O!OO", &PyDict_Type, &rows, &find_layout, &decode_in_python))
        return NULL;
    size_t room = 16;
    while (room < 2 * (size_t)PyDict_Size(rows))
        room *= 2;
    Table *self = (Table *)PyType_GenericAlloc(state->types[TABLE], 0);
    if (self == NULL)
        return NULL;
    self->find_layout = new_reference(find_layout);
    self->decode_in_python = new_reference(decode_in_python);
    self->owned = PyList_New(0);
    self->memory = PyMem_Calloc(room, sizeof(Row));
    self->mask = (uint32_t)room - 1;
    self->state = state;
    int result = self->memory == NULL || self->owned == NULL ? -1 : 0;
    for (Py_ssize_t at = 0; result == 0 && PyDict_Next(rows, &at, &id, &row);)
        result = add_row(self, id, row);
    if (result == 0)
        return (PyObject *)self;
    Py_DECREF(self);
    return PyErr_Occurred() ? NULL : PyErr_NoMemory();
}

/* decode(frame): implements `Dialect.decode`. */
static PyObject *table_decode(PyObject *object, PyObject *frame) {
    Table *self = (Table *)object;
    Row *row = Py_TYPE(frame) == self->state->classes[FRAME] ? find_row(self, ((Frame *)frame)->message_id) : NULL;
    if (row != NULL && row->layout == NULL) { /* this is the first message of its class */
        PyObject *layout = PyObject_CallFunctionObjArgs(self->find_layout, row->id, NULL);
        int result = layout == NULL ? -1 : PyList_Append(self->owned, layout);
        row->layout = result == 0 ? layout : row->layout;
        Py_XDECREF(layout);
        if (result < 0)
            return NULL;
    }
    return row != NULL && Py_TYPE(row->layout) == self->state->types[LAYOUT]
               ? layout_decode(row->layout, frame)
               : PyObject_CallFunctionObjArgs(self->decode_in_python, frame, NULL);
}

/* -------------------------------------------------------------------------------------------- framing */

enum { KEYS = 16 };

typedef struct {
    PyObject_HEAD
    PyObject *wanted, *statistics, *rest, *sources, *table;
    PyObject *keys[KEYS]; /* keys of senders: the objects in ``sources``, because a lookup of the same object is faster */
    void *memory;         /* not used, but required by OWNER */
    int is_out_of_order;  /* 1 if a frame of the last call was out of order */
    int is_simple; /* 1 if ``rest`` is the beginning of one plausible frame, 0 if the attribute `_scan` describes it */
} Framer;

#define OBJECT(name, member) MEMBER(name, T_OBJECT_EX, Framer, member)
static PyMemberDef framer_members[] = {
    OBJECT("wanted", wanted),   OBJECT("statistics", statistics), OBJECT("_rest", rest),
    OBJECT("_sources", sources), OBJECT("_table", table), {0},
};

OWNER(framer, Framer, wanted, 5 + KEYS)

/* State of one call of `receive`. It owns references to its objects. */
typedef struct {
    State *state;
    PyObject *framer, *data, *now, *wanted, *sources, *table, *frames;
    const uint8_t *bytes;
    Py_ssize_t size;
    int is_continued, is_simple; /* 1 if the data begins with the rest of an earlier call; as in Framer, at the begin */
} Run;

enum { GOOD, WAIT, OTHER };

/* Examine the byte at ``begin`` like `PythonFramer._examine`. The verdict is OTHER in all cases for Python code. */
static int examine(const Run *run, Py_ssize_t begin, Py_ssize_t *end, Row **row) {
    const uint8_t *at = run->bytes + begin;
    Py_ssize_t left = run->size - begin;
    int is_v1 = at[0] == MAGIC_V1, header = is_v1 ? 6 : 10;
    if (!is_v1 && at[0] != MAGIC_V2)
        return OTHER;
    if (left < header + 2) {
        *end = begin + (!is_v1 && left < 3 ? 3 : header + 2);
        return is_v1 || left < 3 || at[2] <= SIGNED ? WAIT : OTHER;
    }
    if (!is_v1 && at[2] > SIGNED)
        return OTHER;
    int length = at[1];
    *end = begin + header + length + 2 + (!is_v1 && at[2] ? SIGNATURE : 0);
    *row = find_row((Table *)run->table, message_id_of(at));
    if (*row == NULL || (is_v1 && (length < (*row)->base_length || length > (*row)->length)))
        return OTHER;
    if (*end > run->size)
        return length <= (*row)->length ? WAIT : OTHER;
    unsigned crc = x25_of_frame(run->state, at, header + length, (uint8_t)(*row)->extra);
    return crc == u16(at + header + length) ? GOOD : OTHER;
}

/* Release what a call has returned. Return 0, or -1 after an error. */
static int finish(PyObject *returned) {
    Py_XDECREF(returned);
    return returned == NULL ? -1 : 0;
}

/* Count a frame of the sender with this key. Return 0, or -1 after an error. */
static int count_frame(Run *run, long key, int sequence) {
    Framer *self = (Framer *)run->framer;
    PyObject **object = &self->keys[(key ^ key >> 8) % KEYS];
    int result = 0;
    if (*object == NULL || PyLong_AsLong(*object) != key) {
        Py_XDECREF(*object);
        if ((*object = PyLong_FromLong(key)) == NULL)
            return -1;
    }
    PyObject *source = PyDict_GetItemWithError(run->sources, *object);
    Py_XINCREF(source);
    if (source == NULL && !PyErr_Occurred())
        source = PyObject_CallMethod(run->framer, "_add_source", "OiO", *object, sequence, run->now);
    if (source != NULL && Py_TYPE(source) != run->state->classes[SOURCE]) {
        PyErr_SetString(PyExc_TypeError, "the counters of a sender must be SourceStatistics");
        Py_CLEAR(source);
    }
    if (source == NULL)
        return -1;
    if ((((Number *)source)->number & 0xFF) == (unsigned)sequence)
        ((Number *)source)->number++;
    else {
        self->is_out_of_order = 1;
        result = finish(PyObject_CallMethod(run->framer, "_count_out_of_order", "OliOn", source, key, sequence,
                                            run->now, PyList_Size(run->frames)));
    }
    Py_DECREF(source);
    return result;
}

/* Count a valid frame, and add it to ``frames`` if it is wanted. Return 0, or -1 after an error. */
static int take_frame(Run *run, Py_ssize_t begin, Py_ssize_t end, const Row *row) {
    const uint8_t *at = run->bytes + begin;
    int is_v1 = at[0] == MAGIC_V1;
    if (count_frame(run, (long)u16(at + (is_v1 ? 3 : 5)), at[is_v1 ? 2 : 4]) < 0)
        return -1;
    int is_wanted = run->wanted == Py_None ? 1 : PySequence_Contains(run->wanted, row->id);
    if (is_wanted <= 0)
        return is_wanted;
    PyObject *whole = begin == 0 && end == run->size ? run->data : NULL;
    PyObject *frame = make_frame(run->state, at, end - begin, run->now, whole);
    int result = frame == NULL ? -1 : PyList_Append(run->frames, frame);
    Py_XDECREF(frame);
    return result;
}

/* Let Python code find the next frame. Return 1, 0 if there is no frame, or -1 after an error. */
static int search(Run *run, Py_ssize_t *begin, Py_ssize_t *end, Row **row) {
    int kept = *begin || !run->is_continued ? 0 : run->is_simple ? 1 : 2;
    PyObject *found = PyObject_CallMethod(run->framer, "_find", "OniOO", run->data, *begin, kept, run->now,
                                          run->frames);
    int result = found == NULL ? -1 : found != Py_None;
    if (result == 1) {
        *begin = PyLong_AsSsize_t(found);
        if (*begin < 0 || *begin >= run->size || examine(run, *begin, end, row) != GOOD) {
            PyErr_SetString(PyExc_RuntimeError, "there is no valid frame where one was found");
            result = -1;
        }
    }
    Py_XDECREF(found);
    return result;
}

/* Process the data, and keep an incomplete frame at its end. Return 0, or -1 after an error. */
static int receive(Run *run) {
    Framer *self = (Framer *)run->framer;
    for (Py_ssize_t begin = 0, end = 0; begin < run->size; begin = end) {
        Row *row = NULL;
        int has_scan = begin == 0 && run->is_continued && !run->is_simple;
        int verdict = examine(run, begin, &end, &row);
        if (verdict == WAIT && !has_scan) {
            PyObject *old = self->rest;
            self->rest = PyBytes_FromStringAndSize((const char *)run->bytes + begin, run->size - begin);
            self->is_simple = 1;
            Py_XDECREF(old);
            return self->rest == NULL ? -1 : 0;
        }
        if (verdict != GOOD || (has_scan && run->bytes[0] == MAGIC_V1)) {
            int found = search(run, &begin, &end, &row);
            if (found <= 0)
                return found;
        }
        if (take_frame(run, begin, end, row) < 0)
            return -1;
    }
    return 0;
}

/* Take references to the objects of a call, and join its data with that of earlier calls. Return 0; -1 for an error. */
static int begin_run(Run *run, PyObject *data) {
    Framer *self = (Framer *)run->framer;
    int is_ready = run->state->classes[FRAME] != NULL;
    for (PyObject **member = &self->wanted; member < self->keys; member++)
        is_ready = is_ready && *member != NULL;
    if (!is_ready || !PyBytes_CheckExact(self->rest) || !PyDict_Check(self->sources) ||
        Py_TYPE(self->table) != run->state->types[TABLE] ||
        Py_TYPE(self->statistics) != run->state->classes[COUNTERS]) {
        PyErr_SetString(PyExc_RuntimeError, "the framer is not initialized");
        return -1;
    }
    run->wanted = new_reference(self->wanted);
    run->sources = new_reference(self->sources);
    run->table = new_reference(self->table);
    run->frames = PyList_New(0);
    run->data = PyBytes_FromObject(data);
    if (run->frames == NULL || run->data == NULL)
        return -1;
    ((Number *)self->statistics)->number += (unsigned long long)PyBytes_Size(run->data);
    if (self->is_out_of_order) { /* the last call may have filled `late` and `foreign` */
        if (finish(PyObject_CallMethod(run->framer, "_clear_out_of_order", NULL)) < 0)
            return -1;
        self->is_out_of_order = 0;
    }
    if (PyBytes_Size(self->rest)) {
        run->is_continued = 1;
        run->is_simple = self->is_simple;
        PyObject *joined = self->rest;
        self->rest = PyBytes_FromStringAndSize(NULL, 0);
        PyBytes_ConcatAndDel(&joined, run->data);
        run->data = joined;
        if (self->rest == NULL || joined == NULL)
            return -1;
    }
    self->is_simple = 0;
    run->bytes = (const uint8_t *)PyBytes_AsString(run->data);
    run->size = PyBytes_Size(run->data);
    return 0;
}

/* receive(data, now=0.0): implements `Framer.receive`. */
static PyObject *framer_receive(PyObject *self, PyTypeObject *type, PyObject *const *args, Py_ssize_t count,
                                PyObject *names) {
    Run run = {.framer = self, .state = PyType_GetModuleState(type)};
    int is_named = names != NULL && PyTuple_Size(names) == 1 &&
                   PyUnicode_CompareWithASCIIString(PyTuple_GetItem(names, 0), "now") == 0;
    if (count < 1 || count + is_named > 2 || (names != NULL && !is_named))
        return PyErr_Format(PyExc_TypeError, "receive() takes data and now, not %zd arguments", count);
    run.now = new_reference(count + is_named == 2 ? args[1] : run.state->zero);
    int result = begin_run(&run, args[0]);
    if (result == 0)
        result = receive(&run);
    if (result == 0 && ((Framer *)self)->is_out_of_order)
        result = finish(PyObject_CallMethod(self, "_sort_out_of_order", "O", run.frames));
    PyObject *frames = result == 0 ? new_reference(run.frames) : NULL;
    clear_all(&run.data, 6);
    return frames;
}

/* ------------------------------------------------------------------------------------- telemetry logs */

/* Return the end of a record according to its header, or -1 if the header is not valid. tlog.py has the same rules. */
static Py_ssize_t record_end(const uint8_t *data, Py_ssize_t size, Py_ssize_t begin) {
    static const uint8_t last_time[8] = {0x00, 0x0E, 0x93, 0x26, 0xDD, 0x03, 0xC0, 0x00}; /* the year 2100 */
    const uint8_t *at = data + begin + 8;
    if (size - begin < 11 || memcmp(data + begin, last_time, 8) > 0)
        return -1;
    if (at[0] == MAGIC_V1)
        return begin + 16 + at[1];
    return at[0] == MAGIC_V2 && at[2] <= SIGNED ? begin + 20 + at[1] + (at[2] ? SIGNATURE : 0) : -1;
}

/* tlog_records(data, begin): return ([(time, frame), …], end of these records). The list ends before the first record
   that is not followed by a valid header, because Python code must check that record. */
static PyObject *wire_tlog_records(PyObject *module, PyObject *args) {
    PyObject *bytes, *records;
    Py_ssize_t begin, end;
    if (!PyArg_ParseTuple(args, "Sn", &bytes, &begin) || (records = PyList_New(0)) == NULL)
        return NULL;
    const uint8_t *data = (const uint8_t *)PyBytes_AsString(bytes);
    Py_ssize_t size = PyBytes_Size(bytes);
    for (; begin >= 0 && begin < size; begin = end) {
        end = record_end(data, size, begin);
        if (end < 0 || end > size || record_end(data, size, end) < 0)
            break;
        uint64_t microseconds = 0;
        for (int i = 0; i < 8; i++)
            microseconds = microseconds << 8 | data[begin + i];
        PyObject *frame = PyBytes_FromStringAndSize((const char *)data + begin + 8, end - begin - 8);
        PyObject *record = Py_BuildValue("dN", (double)microseconds / 1e6, frame); /* "y#" depends on the headers */
        if (record == NULL || PyList_Append(records, record) < 0) {
            Py_XDECREF(record);
            Py_DECREF(records);
            return NULL;
        }
        Py_DECREF(record);
    }
    return Py_BuildValue("Nn", records, begin);
}

/* --------------------------------------------------------------------------------------------- module */

#define METHOD(name, function, flags) {name, (PyCFunction)(void (*)(void))function, flags, NULL}

static PyMethodDef layout_methods[] = {METHOD("decode", layout_decode, METH_O), {0}};
static PyMethodDef table_methods[] = {METHOD("decode", table_decode, METH_O), {0}};
static PyMethodDef framer_methods[] = {
    METHOD("receive", framer_receive, METH_METHOD | METH_FASTCALL | METH_KEYWORDS), {0}};
static PyMethodDef functions[] = {
    METHOD("x25", wire_x25, METH_O),
    METHOD("register", wire_register, METH_VARARGS),
    METHOD("layout", wire_layout, METH_VARARGS),
    METHOD("table", wire_table, METH_VARARGS),
    METHOD("encode_frame", wire_encode_frame, METH_VARARGS),
    METHOD("tlog_records", wire_tlog_records, METH_VARARGS), {0},
};

#define GC_SLOTS(name)                                                                                                 \
    {Py_tp_traverse, name##_traverse}, {Py_tp_clear, name##_clear}, {Py_tp_dealloc, name##_dealloc},                   \
    {Py_tp_methods, name##_methods}

static PyType_Slot frame_slots[] = {
    {Py_tp_members, frame_members}, {Py_tp_getset, frame_getters}, {Py_tp_dealloc, frame_dealloc}, {0}};
static PyType_Slot source_slots[] = {{Py_tp_members, source_members}, {Py_tp_dealloc, free_object}, {0}};
static PyType_Slot counter_slots[] = {{Py_tp_members, counter_members}, {Py_tp_dealloc, free_object}, {0}};
static PyType_Slot layout_slots[] = {GC_SLOTS(layout), {0}};
static PyType_Slot table_slots[] = {GC_SLOTS(table), {0}};
static PyType_Slot framer_slots[] = {GC_SLOTS(framer), {Py_tp_members, framer_members}, {0}};

enum { BASE = Py_TPFLAGS_DEFAULT | Py_TPFLAGS_BASETYPE, GC = Py_TPFLAGS_DEFAULT | Py_TPFLAGS_HAVE_GC };

/* The order is that of `State.types`. */
static PyType_Spec specs[] = {
    {"aerokit._wire.FrameFields", sizeof(Frame), 0, BASE, frame_slots},
    {"aerokit._wire.SourceFields", sizeof(Number), 0, BASE, source_slots},
    {"aerokit._wire.CounterFields", sizeof(Number), 0, BASE, counter_slots},
    {"aerokit._wire.FramerFields", sizeof(Framer), 0, BASE | GC, framer_slots},
    {"aerokit._wire.Table", sizeof(Table), 0, GC | Py_TPFLAGS_DISALLOW_INSTANTIATION, table_slots},
    {"aerokit._wire.Layout", sizeof(Layout), 0, GC | Py_TPFLAGS_DISALLOW_INSTANTIATION, layout_slots},
};

static int wire_exec(PyObject *module) {
    State *state = PyModule_GetState(module);
    fill_crc_tables(state);
    for (int i = 0; i < TYPES; i++) {
        state->types[i] = (PyTypeObject *)PyType_FromModuleAndSpec(module, &specs[i], NULL);
        if (state->types[i] == NULL || PyModule_AddType(module, state->types[i]) < 0)
            return -1;
    }
    state->zero = PyFloat_FromDouble(0.0);
    state->layout_name = PyUnicode_InternFromString("_LAYOUT");
    return PyErr_Occurred() ? -1 : PyModule_AddIntConstant(module, "VERSION", VERSION);
}

static int wire_traverse(PyObject *module, visitproc visit, void *arg) {
    return visit_all(PyModule_GetState(module), STATE_OBJECTS, visit, arg);
}
static int wire_clear(PyObject *module) { return clear_all(PyModule_GetState(module), STATE_OBJECTS); }

static PyModuleDef_Slot slots[] = {{Py_mod_exec, wire_exec}, {0}};
static struct PyModuleDef definition = {
    PyModuleDef_HEAD_INIT, "aerokit._wire", "The compiled wire.", sizeof(State), functions, slots, wire_traverse, wire_clear, NULL};

PyMODINIT_FUNC PyInit__wire(void) { return PyModuleDef_Init(&definition); }
