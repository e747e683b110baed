"""Decompression of LZF, the format of the body of a `binary_compressed` PCD file."""


def decompress_lzf(data: bytes, size: int) -> bytes:
    """Decompress an LZF stream to `size` bytes.

    A control byte below 32 precedes that many literal bytes and one more. Any other holds in its three upper bits
    the length of a copy, less 2 (7 means that a further byte adds to it), and in its five lower bits the upper part
    of how far back the copy begins, whose lower part is the next byte (M. Lehmann, LibLZF).

    Raises:
        ValueError: the stream is damaged.
    """
    out = bytearray()
    at, end = 0, len(data)
    try:
        while at < end:
            control = data[at]
            at += 1
            if control < 32:
                out += data[at : at + control + 1]
                at += control + 1
                continue
            length = control >> 5
            if length == 7:
                length += data[at]
                at += 1
            begin = len(out) - ((control & 31) << 8) - data[at] - 1
            at += 1
            if begin < 0:
                raise ValueError("a copy begins before the output")
            # A copy may reach into what it is itself about to write; it then repeats what there is.
            pattern = out[begin : begin + length + 2]
            repeats = -(-(length + 2) // len(pattern))
            out += (pattern * repeats)[: length + 2]
    except IndexError:
        raise ValueError("the stream ends within a copy") from None
    if len(out) != size:
        raise ValueError(f"expected {size} bytes, got {len(out)}")
    return bytes(out)
