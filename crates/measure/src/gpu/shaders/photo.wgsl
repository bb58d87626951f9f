fn byte_of(word: u32, at: u32) -> f32 {
    return f32((word >> (8u * (at & 3u))) & 255u) / 255.0;
}

fn truth_at(pixel: u32, channel: u32) -> f32 {
    let at = 3u * pixel + channel;
    return byte_of(photo[at >> 2u], at);
}

fn weight_at(pixel: u32) -> f32 {
    if (task.flags.x & FLAG_MASK) == 0u {
        return 1.0;
    }
    return byte_of(mask[pixel >> 2u], pixel);
}

// Render and truth; where the mask hides the pixel, the truth for both.
fn pair_at(pixel: u32, channel: u32) -> vec2f {
    let truth = truth_at(pixel, channel);
    let weight = weight_at(pixel);
    // Selected, not just multiplied: a non-finite render must not pass through a weight of 0.
    if weight > 0.0 {
        return vec2f(truth + (frame[channel * task.size.x * task.size.y + pixel] - truth) * weight, truth);
    }
    return vec2f(truth);
}
