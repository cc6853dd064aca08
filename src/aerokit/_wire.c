/* The compiled wire: framing, decoding, encoding, checksums, and records of telemetry logs.

   The Python modules of aerokit.mavlink are the reference: same results, same counters, same errors. What is rare
   (noise, unknown messages, frames out of order, new senders, invalid values) is left to them, by a call.

   The input is hostile: every read of it is behind a check of its length. Data is held in immutable bytes, which are
   owned during every call of Python code. Fields of messages are read and written in the slots of their class: the
   offsets are found, and verified, once for each class (`slot_of`).

   Only the limited API is used, so that one binary serves all versions of Python from 3.10. Nothing is static but
   constants: each interpreter has its own module state. An interpreter with its own GIL refuses the module, because
   declaring support needs the API of 3.12, and uses the Python wire; so does free-threaded Python, for which
   hatch_build.py does not build it, because the state of a framer is protected by the GIL. */

#define PY_SSIZE_T_CLEAN
#include <Python.h>
#include <structmember.h>

#include <float.h>
#include <stddef.h>
#include <stdint.h>
#include <string.h>

#define VERSION 1 /* as in _internal/wire.py */

enum { MAGIC_V1 = 0xFE, MAGIC_V2 = 0xFD, SIGNED = 1, SIGNATURE = 13, HEADER = 9, MAX_PAYLOAD = 255, MAX_FRAME = 280 };

typedef struct {
    PyTypeObject *frame_fields, *source_fields, *counter_fields, *framer, *table, *layout;
    PyTypeObject *frame; /* the class of Python, or NULL before `register_frame` */
    PyObject *zero, *decode_body, *layout_name;
    uint16_t crc[8][256];
} State;

enum { STATE_OBJECTS = offsetof(State, crc) / sizeof(PyObject *) };

static unsigned u16(const uint8_t *at) {
    return (unsigned)(at[0] | at[1] << 8);
}

static uint64_t little_endian(const uint8_t *at, int size) {
    uint64_t value = 0;
    for (int i = size - 1; i >= 0; i--)
        value = value << 8 | at[i];
    return value;
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

/* Define garbage collection of a type whose instances own ``count`` objects from ``first`` on, and ``memory``. */
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
    for (int byte = 0; byte < 256; byte++) {
        unsigned crc = (unsigned)byte;
        for (int bit = 0; bit < 8; bit++)
            crc = crc & 1 ? crc >> 1 ^ 0x8408 : crc >> 1;
        state->crc[0][byte] = (uint16_t)crc;
    }
    for (int row = 1; row < 8; row++) /* the same byte, followed by ``row`` zeros */
        for (int byte = 0; byte < 256; byte++) {
            unsigned crc = state->crc[row - 1][byte];
            state->crc[row][byte] = (uint16_t)(crc >> 8 ^ state->crc[0][crc & 0xFF]);
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

/* The checksum of a frame: without the magic byte, and with CRC_EXTRA. */
static unsigned x25_of_frame(const State *state, const uint8_t *frame, Py_ssize_t size, uint8_t extra) {
    return x25(state, &extra, 1, x25(state, frame + 1, size - 1, 0xFFFF));
}

/* x25(data): `aerokit.mavlink.frame.x25`. */
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

static PyMemberDef frame_members[] = {
    {"body", T_OBJECT_EX, offsetof(Frame, body), 0, NULL},
    {"received_at", T_OBJECT_EX, offsetof(Frame, received_at), 0, NULL},
    {"_raw", T_OBJECT_EX, offsetof(Frame, raw), 0, NULL},
    {"message_id", T_UINT, offsetof(Frame, message_id), 0, NULL},
    {"checksum", T_USHORT, offsetof(Frame, checksum), 0, NULL},
    {"system_id", T_UBYTE, offsetof(Frame, system_id), 0, NULL},
    {"component_id", T_UBYTE, offsetof(Frame, component_id), 0, NULL},
    {0},
};

static void frame_dealloc(PyObject *self) {
    clear_all(&((Frame *)self)->body, 3);
    free_object(self);
}

/* Create a frame from ``raw``, a whole one of ``size`` bytes. ``whole`` has the same bytes as an object, or is NULL. */
static PyObject *make_frame(State *state, const uint8_t *raw, Py_ssize_t size, PyObject *received_at, PyObject *whole) {
    Frame *frame = (Frame *)PyType_GenericAlloc(state->frame, 0);
    if (frame == NULL)
        return NULL;
    int is_v1 = raw[0] == MAGIC_V1, length = raw[1];
    frame->message_id = is_v1 ? raw[5] : (uint32_t)little_endian(raw + 7, 3);
    frame->checksum = (unsigned short)u16(raw + (is_v1 ? 6 : 10) + length);
    frame->system_id = raw[is_v1 ? 3 : 5];
    frame->component_id = raw[is_v1 ? 4 : 6];
    frame->received_at = new_reference(received_at);
    frame->body = PyBytes_FromStringAndSize(is_v1 ? NULL : (const char *)raw + 1, HEADER + length);
    if (is_v1 && frame->body != NULL) {
        uint8_t *body = (uint8_t *)PyBytes_AsString(frame->body);
        const uint8_t header[HEADER] = {raw[1], 0, 0, raw[2], raw[3], raw[4], raw[5], 0, 0};
        memcpy(body, header, HEADER);
        memcpy(body + HEADER, raw + 6, (size_t)length);
    }
    if (is_v1 || raw[2]) { /* `Frame.raw` cannot reconstruct these */
        Py_XINCREF(whole);
        frame->raw = whole != NULL ? whole : PyBytes_FromStringAndSize((const char *)raw, size);
        if (frame->raw == NULL)
            Py_CLEAR(frame->body);
    }
    if (frame->body == NULL) {
        Py_DECREF(frame);
        return NULL;
    }
    return (PyObject *)frame;
}

/* register_frame(class): set the class of frames. */
static PyObject *wire_register_frame(PyObject *module, PyObject *frame) {
    State *state = PyModule_GetState(module);
    if (!PyType_Check(frame) || !PyType_IsSubtype((PyTypeObject *)frame, state->frame_fields)) {
        PyErr_SetString(PyExc_TypeError, "the class of frames must be derived from FrameFields");
        return NULL;
    }
    Py_XDECREF(state->frame);
    state->frame = (PyTypeObject *)new_reference(frame);
    Py_RETURN_NONE;
}

typedef struct {
    PyObject_HEAD
    unsigned long long number; /* `SourceStatistics.expected`, or `FramerStatistics.bytes` */
} Number;

static PyMemberDef source_members[] = {{"expected", T_ULONGLONG, offsetof(Number, number), 0, NULL}, {0}};
static PyMemberDef counter_members[] = {{"bytes", T_ULONGLONG, offsetof(Number, number), 0, NULL}, {0}};

/* -------------------------------------------------------------------------- layouts of message classes */

typedef struct {
    int kind, count;  /* as in struct; "s" for a text, "p" for bytes; elements, 0 if it is not an array */
    int offset, size; /* in the payload; of an element */
    Py_ssize_t slot;  /* offset in the message */
} Field;

typedef struct {
    PyObject_HEAD
    PyObject *message_class;
    Py_ssize_t frame_slot;
    Field *memory; /* the fields, in the order of the wire */
    int field_count, id, crc_extra, length, base_length;
} Layout;

static PyObject **at_slot(PyObject *object, Py_ssize_t slot) {
    return (PyObject **)(void *)((char *)object + slot);
}

OWNER(layout, Layout, message_class, 1)

/* Find the offset of a slot, by storing an object in it; 0 if it cannot be found, -1 for an error. */
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
    switch (kind) {
    case 'h': case 'H': return 2;
    case 'i': case 'I': case 'f': return 4;
    case 'q': case 'Q': case 'd': return 8;
    case 'b': case 'B': case 's': case 'p': return 1;
    default: return 0;
    }
}

/* Fill the fields: 1, 0 if the class needs Python, -1 for an error. */
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
        field->size = size_of(field->kind);
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

/* layout(class, id, CRC_EXTRA, length, base length, ((name, kind, count), …)): None if the class needs Python. */
static PyObject *wire_layout(PyObject *module, PyObject *args) {
    State *state = PyModule_GetState(module);
    PyObject *message_class, *rows;
    Layout *self = (Layout *)PyType_GenericAlloc(state->layout, 0);
    int result = -1;
    if (self != NULL && PyArg_ParseTuple(args, "O!iiiiO!", &PyType_Type, &message_class, &self->id, &self->crc_extra,
                                         &self->length, &self->base_length, &PyTuple_Type, &rows)) {
        self->message_class = new_reference(message_class);
        result = fill_layout(self, rows);
    }
    if (result > 0)
        return (PyObject *)self;
    Py_XDECREF(self);
    if (result < 0)
        return NULL;
    Py_RETURN_NONE;
}

/* ------------------------------------------------------------------------------------------- decoding */

/* Return the number at ``at``; NULL without an exception for a signalling NaN, of which versions of Python make
   different floats. */
static PyObject *decode_number(int kind, const uint8_t *at) {
    switch (kind) {
    case 'b': return PyLong_FromLong((int8_t)at[0]);
    case 'B': return PyLong_FromLong(at[0]);
    case 'h': return PyLong_FromLong((int16_t)u16(at));
    case 'H': return PyLong_FromLong((long)u16(at));
    case 'i': return PyLong_FromLong((int32_t)little_endian(at, 4));
    case 'I': return PyLong_FromLongLong((long long)little_endian(at, 4));
    case 'q': return PyLong_FromLongLong((int64_t)little_endian(at, 8));
    case 'Q': return PyLong_FromUnsignedLongLong(little_endian(at, 8));
    case 'f': {
        uint32_t bits = (uint32_t)little_endian(at, 4);
        float value;
        memcpy(&value, &bits, 4);
        return (bits & 0x7FC00000) == 0x7F800000 && bits & 0x3FFFFF ? NULL : PyFloat_FromDouble(value);
    }
    default: {
        uint64_t bits = little_endian(at, 8);
        double value;
        memcpy(&value, &bits, 8);
        return PyFloat_FromDouble(value);
    }
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

/* Decode a `Frame.body` (header of nine bytes, payload). Both arguments must be owned by the caller. */
static PyObject *decode_body(State *state, Layout *self, PyObject *body, PyObject *frame) {
    PyObject *message = NULL, *value;
    if (!PyBytes_CheckExact(body) || self->message_class == NULL)
        goto python;
    const uint8_t *payload = (const uint8_t *)PyBytes_AsString(body) + HEADER;
    Py_ssize_t size = PyBytes_Size(body) - HEADER;
    uint8_t restored[MAX_PAYLOAD];
    if (size < self->length) { /* trailing zeros were truncated */
        memset(restored, 0, (size_t)self->length);
        if (size > 0)
            memcpy(restored, payload, (size_t)size);
        payload = restored;
    }
    message = PyType_GenericAlloc((PyTypeObject *)self->message_class, 0);
    if (message == NULL)
        return NULL;
    *at_slot(message, self->frame_slot) = new_reference(frame);
    for (int i = 0; i < self->field_count; i++) {
        value = *at_slot(message, self->memory[i].slot) = decode_field(&self->memory[i], payload);
        if (value == NULL)
            goto python;
    }
    return message;
python:
    Py_XDECREF(message);
    if (PyErr_Occurred() || self->message_class == NULL)
        return PyErr_Occurred() ? NULL : PyErr_NoMemory();
    return PyObject_CallMethodObjArgs(self->message_class, state->decode_body, body, frame, NULL);
}

/* decode(body, frame): `Message.decode_body` of the class. */
static PyObject *layout_decode(PyObject *self, PyTypeObject *type, PyObject *const *args, Py_ssize_t count, PyObject *names) {
    if (count < 1 || count > 2 || names != NULL) {
        PyErr_SetString(PyExc_TypeError, "decode() takes body and frame");
        return NULL;
    }
    return decode_body(PyType_GetModuleState(type), (Layout *)self, args[0], count == 2 ? args[1] : Py_None);
}

/* ------------------------------------------------------------------------------------------- encoding */

/* Encode one number: 1, or 0 if Python has to convert it, or to explain why it is invalid. */
static int encode_number(int kind, int size, PyObject *value, uint8_t *at) {
    if (kind == 'f' || kind == 'd') {
        if (!PyFloat_Check(value) && !PyLong_Check(value))
            return 0;
        double number = PyFloat_AsDouble(value);
        if (PyErr_Occurred())
            return 0;
        uint64_t bits;
        memcpy(&bits, &number, 8);
        if (kind == 'f') {
            int is_finite = number - number == 0;
            if ((is_finite && (number > FLT_MAX || number < -FLT_MAX)) || number != number) /* too large, or NaN */
                return 0;
            float narrow = (float)number;
            uint32_t narrow_bits;
            memcpy(&narrow_bits, &narrow, 4);
            bits = narrow_bits;
        }
        put_little_endian(at, size, bits);
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
    int is_signed = kind == 'b' || kind == 'h' || kind == 'i' || kind == 'q';
    if (kind != 'q') {
        long long limit = 1LL << (8 * size - is_signed);
        if (number >= limit || number < (is_signed ? -limit : 0))
            return 0;
    }
    put_little_endian(at, size, (uint64_t)number);
    return 1;
}

/* Encode the value of a field, whose bytes are zero: 1, or 0 if Python has to. */
static int encode_field(const Field *field, PyObject *value, uint8_t *at) {
    Py_ssize_t size = field->count ? field->count : 1, length = 0;
    const char *text = NULL;
    if (field->kind == 's' || field->kind == 'p') {
        if (field->kind == 's' && PyUnicode_CheckExact(value))
            text = PyUnicode_AsUTF8AndSize(value, &length);
        else if (field->kind == 'p' && PyBytes_CheckExact(value)) {
            text = PyBytes_AsString(value);
            length = PyBytes_Size(value);
        }
        if (text == NULL || length > size)
            return 0;
        memcpy(at, text, (size_t)length);
        return 1;
    }
    if (!field->count)
        return encode_number(field->kind, field->size, value, at);
    if (!PyTuple_CheckExact(value) || PyTuple_Size(value) > size) /* code of an item could change a list */
        return 0;
    for (Py_ssize_t i = 0; i < PyTuple_Size(value); i++)
        if (!encode_number(field->kind, field->size, PyTuple_GetItem(value, i), at + i * field->size))
            return 0;
    return 1;
}

/* Encode a message into ``frame``, of MAX_FRAME bytes: its size without the signature, or 0 if Python has to. */
static Py_ssize_t encode(State *state, PyObject *message, int version, const uint8_t head[4], uint8_t *frame) {
    Py_ssize_t total = 0;
    Layout *layout = (Layout *)PyObject_GetAttr((PyObject *)Py_TYPE(message), state->layout_name);
    if (layout == NULL || Py_TYPE(layout) != state->layout || layout->message_class != (PyObject *)Py_TYPE(message) ||
        (version == 1 && layout->id > 0xFF))
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

/* encode_frame(message, version, flags, sequence, system_id, component_id): a whole frame without its signature, or
   None if Python has to encode it; errors too are those of Python. */
static PyObject *wire_encode_frame(PyObject *module, PyObject *const *args, Py_ssize_t count) {
    uint8_t head[4], frame[MAX_FRAME];
    long numbers[5];
    if (count != 6) {
        PyErr_SetString(PyExc_TypeError, "encode_frame() takes six arguments");
        return NULL;
    }
    for (int i = 0; i < 5; i++)
        numbers[i] = PyLong_AsLong(args[i + 1]);
    for (int i = 0; i < 4; i++)
        head[i] = (uint8_t)numbers[i + 1];
    if (PyErr_Occurred())
        return NULL;
    Py_ssize_t size = encode(PyModule_GetState(module), args[0], (int)numbers[0], head, frame);
    if (size)
        return PyBytes_FromStringAndSize((char *)frame, size);
    if (PyErr_Occurred() && !PyErr_ExceptionMatches(PyExc_Exception))
        return NULL;
    PyErr_Clear();
    Py_RETURN_NONE;
}

/* ------------------------------------------------------------------------------------------- dialects */

typedef struct {
    PyObject *id, *layout; /* in the lists of the table; id is NULL in a free row; layout is NULL until it is needed */
    uint32_t number;
    int extra, base_length, length;
} Row;

typedef struct {
    PyObject_HEAD
    PyObject *owned; /* a list of what rows refer to */
    PyObject *find_layout, *decode_in_python;
    Row *memory; /* the rows, hashed by message id, at most half full */
    uint32_t mask;
} Table;

OWNER(table, Table, owned, 3)

/* Find the row of a message id, or the free one where it would be. */
static Row *row_of(const Table *self, uint32_t number) {
    uint32_t at = number * 2654435761u >> 12 & self->mask;
    while (self->memory[at].id != NULL && self->memory[at].number != number)
        at = (at + 1) & self->mask;
    return &self->memory[at];
}

/* Return NULL for an unknown message, and for a table that is being destroyed. */
static Row *find_row(const Table *self, uint32_t number) {
    Row *row = row_of(self, number);
    return row->id != NULL && self->owned != NULL ? row : NULL;
}

static int add_row(Table *self, PyObject *id, PyObject *row) {
    Row new = {.id = id};
    unsigned long number = PyLong_AsUnsignedLong(id);
    if (PyErr_Occurred() || !PyArg_ParseTuple(row, "iii", &new.extra, &new.base_length, &new.length))
        return -1;
    if (number > 0xFFFFFF) /* no frame has such an id */
        return 0;
    new.number = (uint32_t)number;
    *row_of(self, new.number) = new;
    return PyList_Append(self->owned, id);
}

/* table(rows, find_layout, decode_in_python): the messages of a dialect. */
static PyObject *wire_table(PyObject *module, PyObject *args) {
    State *state = PyModule_GetState(module);
    PyObject *rows, *find_layout, *decode_in_python, *id, *row;
    if (!PyArg_ParseTuple(args, "O!OO", &PyDict_Type, &rows, &find_layout, &decode_in_python))
        return NULL;
    size_t room = 16;
    while (room < 2 * (size_t)PyDict_Size(rows))
        room *= 2;
    Table *self = (Table *)PyType_GenericAlloc(state->table, 0);
    if (self == NULL)
        return NULL;
    self->find_layout = new_reference(find_layout);
    self->decode_in_python = new_reference(decode_in_python);
    self->owned = PyList_New(0);
    self->mask = (uint32_t)room - 1;
    self->memory = PyMem_Calloc(room, sizeof(Row));
    int result = self->memory == NULL || self->owned == NULL ? -1 : 0;
    for (Py_ssize_t at = 0; result == 0 && PyDict_Next(rows, &at, &id, &row);)
        result = add_row(self, id, row);
    if (result == 0)
        return (PyObject *)self;
    Py_DECREF(self);
    return PyErr_Occurred() ? NULL : PyErr_NoMemory();
}

/* decode(frame): `Dialect.decode`. */
static PyObject *table_decode(PyObject *object, PyTypeObject *type, PyObject *const *args, Py_ssize_t count,
                              PyObject *names) {
    Table *self = (Table *)object;
    State *state = PyType_GetModuleState(type);
    if (count != 1 || names != NULL) {
        PyErr_SetString(PyExc_TypeError, "decode() takes exactly one frame");
        return NULL;
    }
    PyObject *frame = args[0];
    Row *row = Py_TYPE(frame) == state->frame ? find_row(self, ((Frame *)frame)->message_id) : NULL;
    if (row != NULL && row->layout == NULL) { /* the first message of its class */
        PyObject *layout = PyObject_CallFunctionObjArgs(self->find_layout, row->id, NULL);
        int result = layout == NULL ? -1 : PyList_Append(self->owned, layout);
        row->layout = result == 0 ? layout : row->layout;
        Py_XDECREF(layout);
        if (result < 0)
            return NULL;
    }
    PyObject *body = row == NULL ? NULL : ((Frame *)frame)->body;
    if (body == NULL || Py_TYPE(row->layout) != state->layout)
        return PyObject_CallFunctionObjArgs(self->decode_in_python, frame, NULL);
    Py_INCREF(body);
    PyObject *message = decode_body(state, (Layout *)row->layout, body, frame);
    Py_DECREF(body);
    return message;
}

/* -------------------------------------------------------------------------------------------- framing */

typedef struct {
    PyObject_HEAD
    PyObject *wanted, *late, *foreign, *statistics, *rest, *sources, *table;
    PyObject *last_key; /* of the last sender, as a number of Python */
    void *memory;       /* not used */
    long last_key_number;
    int is_simple; /* 1 if ``rest`` is the beginning of a single plausible frame, 0 if `_scan` of Python describes it */
} Framer;

static PyMemberDef framer_members[] = {
    {"wanted", T_OBJECT_EX, offsetof(Framer, wanted), 0, NULL},
    {"late", T_OBJECT_EX, offsetof(Framer, late), 0, NULL},
    {"foreign", T_OBJECT_EX, offsetof(Framer, foreign), 0, NULL},
    {"statistics", T_OBJECT_EX, offsetof(Framer, statistics), 0, NULL},
    {"_rest", T_OBJECT_EX, offsetof(Framer, rest), 0, NULL},
    {"_sources", T_OBJECT_EX, offsetof(Framer, sources), 0, NULL},
    {"_table", T_OBJECT_EX, offsetof(Framer, table), 0, NULL},
    {0},
};

OWNER(framer, Framer, wanted, 8)

/* One call of `receive`. It owns its objects. */
typedef struct {
    State *state;
    PyObject *framer, *data, *now, *wanted, *sources, *table, *frames;
    const uint8_t *bytes;
    Py_ssize_t size;
    int is_continued, is_simple, is_out_of_order; /* the data begins with the rest of an earlier call; as in Framer */
} Run;

enum { GOOD, WAIT, OTHER };

/* Judge the byte at ``begin`` as `PythonFramer._examine` does, with one verdict for all that needs Python. */
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
    *row = find_row((Table *)run->table, is_v1 ? at[5] : (uint32_t)little_endian(at + 7, 3));
    if (*row == NULL || (is_v1 && (length < (*row)->base_length || length > (*row)->length)))
        return OTHER;
    if (*end > run->size)
        return length <= (*row)->length ? WAIT : OTHER;
    unsigned crc = x25_of_frame(run->state, at, header + length, (uint8_t)(*row)->extra);
    return crc == u16(at + header + length) ? GOOD : OTHER;
}

/* Count a frame of a sender. */
static int count_frame(Run *run, long key, int sequence) {
    Framer *self = (Framer *)run->framer;
    if (self->last_key == NULL || self->last_key_number != key) {
        PyObject *old = self->last_key;
        self->last_key = PyLong_FromLong(key);
        self->last_key_number = key;
        Py_XDECREF(old);
        if (self->last_key == NULL)
            return -1;
    }
    PyObject *source = PyDict_GetItemWithError(run->sources, self->last_key), *done = Py_None;
    Py_XINCREF(source);
    if (source == NULL && !PyErr_Occurred())
        source = PyObject_CallMethod(run->framer, "_add_source", "liO", key, sequence, run->now);
    if (source != NULL && !PyObject_TypeCheck(source, run->state->source_fields)) {
        PyErr_SetString(PyExc_TypeError, "the counters of a sender must be SourceStatistics");
        Py_CLEAR(source);
    }
    if (source == NULL)
        return -1;
    if ((((Number *)source)->number & 0xFF) == (unsigned)sequence)
        ((Number *)source)->number++;
    else {
        run->is_out_of_order = 1;
        done = PyObject_CallMethod(run->framer, "_count_out_of_order", "OliOn", source, key, sequence, run->now,
                                   PyList_Size(run->frames));
        Py_XDECREF(done);
    }
    Py_DECREF(source);
    return done == NULL ? -1 : 0;
}

/* Count a valid frame, and return it if it is wanted. */
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

/* Find the next frame in Python: 1, 0 if there is none, -1 for an error. */
static int search(Run *run, Py_ssize_t *begin, Py_ssize_t *end, Row **row) {
    int kept = *begin || !run->is_continued ? 0 : run->is_simple ? 1 : 2;
    PyObject *found = PyObject_CallMethod(run->framer, "_find", "OniOO", run->data, *begin, kept, run->now, run->frames);
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

/* Process the data. An unfinished frame at its end is kept. */
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

/* Own the objects of a call, and join the data with what was kept. */
static int begin_run(Run *run, PyObject *data) {
    Framer *self = (Framer *)run->framer;
    if (self->wanted == NULL || self->late == NULL || self->foreign == NULL || self->statistics == NULL ||
        self->rest == NULL || self->sources == NULL || self->table == NULL || run->state->frame == NULL ||
        !PyBytes_CheckExact(self->rest) || !PyDict_Check(self->sources) || Py_TYPE(self->table) != run->state->table ||
        !PyObject_TypeCheck(self->statistics, run->state->counter_fields)) {
        PyErr_SetString(PyExc_RuntimeError, "the framer is not initialized");
        return -1;
    }
    run->wanted = new_reference(self->wanted);
    run->sources = new_reference(self->sources);
    run->table = new_reference(self->table);
    run->frames = PyList_New(0);
    run->data = PyBytes_CheckExact(data) ? new_reference(data)
                                         : PyObject_CallFunctionObjArgs((PyObject *)&PyBytes_Type, data, NULL);
    if (run->frames == NULL || run->data == NULL)
        return -1;
    ((Number *)self->statistics)->number += (unsigned long long)PyBytes_Size(run->data);
    int is_late = PyObject_IsTrue(self->late), is_foreign = PyObject_IsTrue(self->foreign);
    if (is_late < 0 || is_foreign < 0)
        return -1;
    if (is_late || is_foreign) {
        PyObject *done = PyObject_CallMethod(run->framer, "_clear_out_of_order", NULL);
        Py_XDECREF(done);
        if (done == NULL)
            return -1;
    }
    if (PyBytes_Size(self->rest)) {
        run->is_continued = 1;
        run->is_simple = self->is_simple;
        PyObject *joined = self->rest;
        self->rest = PyBytes_FromStringAndSize(NULL, 0);
        PyBytes_Concat(&joined, run->data);
        Py_DECREF(run->data);
        run->data = joined;
        if (self->rest == NULL || joined == NULL)
            return -1;
    }
    self->is_simple = 0;
    run->bytes = (const uint8_t *)PyBytes_AsString(run->data);
    run->size = PyBytes_Size(run->data);
    return 0;
}

/* receive(data, now=0.0): `Framer.receive`. */
static PyObject *framer_receive(PyObject *self, PyTypeObject *type, PyObject *const *args, Py_ssize_t count,
                                PyObject *names) {
    Run run = {.framer = self, .state = PyType_GetModuleState(type)};
    int is_named = names != NULL && PyTuple_Size(names) == 1 &&
                   PyUnicode_CompareWithASCIIString(PyTuple_GetItem(names, 0), "now") == 0;
    if (count < 1 || count + is_named > 2 || (names != NULL && !is_named)) {
        PyErr_SetString(PyExc_TypeError, "receive() takes data and now");
        return NULL;
    }
    run.now = new_reference(count + is_named == 2 ? args[1] : run.state->zero);
    int result = begin_run(&run, args[0]);
    if (result == 0)
        result = receive(&run);
    if (result == 0 && run.is_out_of_order) {
        PyObject *done = PyObject_CallMethod(self, "_sort_out_of_order", "O", run.frames);
        result = done == NULL ? -1 : 0;
        Py_XDECREF(done);
    }
    PyObject *frames = result == 0 ? new_reference(run.frames) : NULL;
    clear_all(&run.data, 6);
    return frames;
}

/* ------------------------------------------------------------------------------------- telemetry logs */

/* Return the end of a record according to its header, or -1 if there is no valid header, as in tlog.py. */
static Py_ssize_t record_end(const uint8_t *data, Py_ssize_t size, Py_ssize_t begin) {
    static const uint8_t last_time[8] = {0x00, 0x0E, 0x93, 0x26, 0xDD, 0x03, 0xC0, 0x00}; /* the year 2100 */
    const uint8_t *at = data + begin + 8;
    if (size - begin < 11 || memcmp(data + begin, last_time, 8) > 0)
        return -1;
    if (at[0] == MAGIC_V1)
        return begin + 16 + at[1];
    return at[0] == MAGIC_V2 && at[2] <= SIGNED ? begin + 20 + at[1] + (at[2] ? SIGNATURE : 0) : -1;
}

/* tlog_records(data, begin): ([(time, frame), …], begin of the first one that Python has to judge). Each record here is
   followed by the header of another one. */
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
        PyObject *record = Py_BuildValue("dy#", (double)microseconds / 1e6, data + begin + 8, end - begin - 8);
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
#define WITH_CLASS (METH_METHOD | METH_FASTCALL | METH_KEYWORDS)

static PyMethodDef layout_methods[] = {METHOD("decode", layout_decode, WITH_CLASS), {0}};
static PyMethodDef table_methods[] = {METHOD("decode", table_decode, WITH_CLASS), {0}};
static PyMethodDef framer_methods[] = {METHOD("receive", framer_receive, WITH_CLASS), {0}};
static PyMethodDef functions[] = {
    METHOD("x25", wire_x25, METH_O),
    METHOD("register_frame", wire_register_frame, METH_O),
    METHOD("layout", wire_layout, METH_VARARGS),
    METHOD("table", wire_table, METH_VARARGS),
    METHOD("encode_frame", wire_encode_frame, METH_FASTCALL),
    METHOD("tlog_records", wire_tlog_records, METH_VARARGS),
    {0},
};

#define GC_SLOTS(name)                                                                                                 \
    {Py_tp_traverse, name##_traverse}, {Py_tp_clear, name##_clear}, {Py_tp_dealloc, name##_dealloc},                   \
    {Py_tp_methods, name##_methods}

static PyType_Slot frame_slots[] = {{Py_tp_members, frame_members}, {Py_tp_dealloc, frame_dealloc}, {0}};
static PyType_Slot source_slots[] = {{Py_tp_members, source_members}, {Py_tp_dealloc, free_object}, {0}};
static PyType_Slot counter_slots[] = {{Py_tp_members, counter_members}, {Py_tp_dealloc, free_object}, {0}};
static PyType_Slot layout_slots[] = {GC_SLOTS(layout), {0}};
static PyType_Slot table_slots[] = {GC_SLOTS(table), {0}};
static PyType_Slot framer_slots[] = {GC_SLOTS(framer), {Py_tp_members, framer_members}, {0}};

enum { BASE = Py_TPFLAGS_DEFAULT | Py_TPFLAGS_BASETYPE, GC = Py_TPFLAGS_DEFAULT | Py_TPFLAGS_HAVE_GC };

/* In the order of `State`. */
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
    PyTypeObject **types[] = {&state->frame_fields, &state->source_fields, &state->counter_fields,
                              &state->framer,       &state->table,         &state->layout};
    for (size_t i = 0; i < sizeof specs / sizeof *specs; i++) {
        *types[i] = (PyTypeObject *)PyType_FromModuleAndSpec(module, &specs[i], NULL);
        if (*types[i] == NULL || PyModule_AddType(module, *types[i]) < 0)
            return -1;
    }
    state->zero = PyFloat_FromDouble(0.0);
    state->decode_body = PyUnicode_InternFromString("decode_body");
    state->layout_name = PyUnicode_InternFromString("_LAYOUT");
    return PyErr_Occurred() ? -1 : PyModule_AddIntConstant(module, "VERSION", VERSION);
}

static int wire_traverse(PyObject *module, visitproc visit, void *arg) {
    return visit_all(PyModule_GetState(module), STATE_OBJECTS, visit, arg);
}

static int wire_clear(PyObject *module) {
    return clear_all(PyModule_GetState(module), STATE_OBJECTS);
}

static PyModuleDef_Slot slots[] = {{Py_mod_exec, wire_exec}, {0}};
static struct PyModuleDef definition = {
    PyModuleDef_HEAD_INIT, "aerokit._wire", "The compiled wire.", sizeof(State), functions, slots, wire_traverse,
    wire_clear,            NULL,
};

PyMODINIT_FUNC
PyInit__wire(void) {
    return PyModuleDef_Init(&definition);
}
